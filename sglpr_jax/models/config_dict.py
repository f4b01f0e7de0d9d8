"""A model's configuration from the plain values of a JSON file, every one of which must have its field's type."""

import dataclasses
import types
import typing
from pathlib import Path
from typing import Any, Literal

from sglpr_jax.models.config import ModelConfig


def config_from_dict(values: Any, *, source: Path | str) -> ModelConfig:
    """What `dataclasses.asdict` was made of; fields that are not there have their defaults.

    Raises ValueError naming `source`, the field, what was expected and what was found.
    """
    try:
        return _read(ModelConfig, values, field="")
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error


def _read(expected: Any, value: Any, field: str) -> Any:
    """The value of a field, of a type that a configuration has: a dataclass, a union, Literal, tuple or plain type."""
    if dataclasses.is_dataclass(expected):
        return _read_dataclass(expected, value, field)
    if isinstance(expected, types.UnionType):
        return _read(_member(expected, value, field), value, field)
    if typing.get_origin(expected) is Literal:
        choices = typing.get_args(expected)
        fits = any(type(value) is type(choice) and value == choice for choice in choices)
        return _require(value, fits, f"one of {', '.join(map(repr, choices))}", field)
    if typing.get_origin(expected) is tuple:
        return _read_tuple(typing.get_args(expected), value, field)
    if expected is types.NoneType:
        return _require(value, value is None, "null", field)
    if expected is float and type(value) is int:
        return float(value)
    return _require(value, type(value) is expected, f"a value of type {expected.__name__}", field)


def _read_dataclass(expected: Any, value: Any, field: str) -> Any:
    _require(value, isinstance(value, dict), f"the fields of a {expected.__name__}", field)
    hints = typing.get_type_hints(expected)
    unknown = min(set(value) - set(hints), default=None)
    _require(unknown, unknown is None, f"the fields of a {expected.__name__} ({', '.join(hints)})", field)
    prefix = f"{field}." if field else ""
    return expected(**{name: _read(hints[name], one, prefix + name) for name, one in value.items()})


def _member(union: Any, value: Any, field: str) -> Any:
    """The member of a union that a value belongs to: a dataclass says its `kind`, None is None."""
    members = typing.get_args(union)
    if not isinstance(value, dict):
        plain = [member for member in members if not dataclasses.is_dataclass(member)]
        return types.NoneType if value is None and types.NoneType in plain else next(iter(plain or members))
    structured: list[Any] = [member for member in members if dataclasses.is_dataclass(member)]
    kinds = {member.kind: member for member in structured}
    _require(value.get("kind"), value.get("kind") in kinds, f"a kind, {' or '.join(kinds)}", field)
    return kinds[value["kind"]]


def _read_tuple(item_types: tuple[Any, ...], value: Any, field: str) -> tuple[Any, ...]:
    _require(value, isinstance(value, list | tuple), "a list", field)
    if item_types[-1] is Ellipsis:
        return tuple(_read(item_types[0], one, field) for one in value)
    _require(value, len(value) == len(item_types), f"a list of {len(item_types)}", field)
    return tuple(_read(type_, one, field) for type_, one in zip(item_types, value, strict=True))


def _require(value: Any, fits: bool, expected: str, field: str) -> Any:
    if not fits:
        raise ValueError(f"{field}{': ' if field else ''}expected {expected}, found {value!r:.60}")
    return value
