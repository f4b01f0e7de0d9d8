"""Conversion of the plain values of a JSON file to a model configuration, with a check of every field."""

import types
import typing
from pathlib import Path
from typing import Annotated, Any

from sglpr_jax.fields import check_value, field_types, is_config, require
from sglpr_jax.files import naming
from sglpr_jax.models.config import ModelConfig

RENAMED = {"rings": "circular"}
"""Kinds of backbones in files of earlier versions, and their names today."""
REMOVED = (("backbone.stem", []),)
"""Fields, with their values, that files of earlier versions have and today's configuration has not."""
ADDED_LATER = {"head.means": (), "head.whiten": False, "backbone.fine": (), "backbone.stem.fine": ()}
"""Values of fields that are missing in files of earlier versions."""


def config_from_dict(values: Any, *, source: Path | str) -> ModelConfig:
    """Rebuild a configuration from the output of `dataclasses.asdict`.

    Every field is required, except the fields in `ADDED_LATER`.

    Raises:
      ValueError: If a field is missing, unknown or invalid. The message names `source`, the field, and the expected and
        the found value.
    """
    with naming(source):
        return _read(ModelConfig, values, field="")


def _read(annotation: Any, value: Any, field: str) -> Any:
    """Converts a value to a field's type: dictionaries to dataclasses, lists to tuples, whole numbers to floats."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    value = _of_today(value, f"{field}." if field else "")
    if is_config(annotation):
        return _read_dataclass(annotation, value, field)
    if origin in (typing.Union, types.UnionType):
        return None if value is None and types.NoneType in parts else _read(_member(parts, value, field), value, field)
    if origin is tuple:
        require(value, isinstance(value, list | tuple), "a list", field)
        items = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
        require(value, len(value) == len(items), f"a list of {len(items)}", field)
        value = tuple(_read(item, one, field) for item, one in zip(items, value, strict=True))
    check_value(value, annotation, field)
    plain = parts[0] if origin is Annotated else annotation
    return float(value) if plain is float else value


def _of_today(value: Any, prefix: str) -> Any:
    """The fields of a file of an earlier version, without removed ones and with the present name of its `kind`."""
    if not isinstance(value, dict):
        return value
    known = {name: one for name, one in value.items() if (prefix + name, one) not in REMOVED}
    old = known.get("kind")
    return {**known, "kind": RENAMED[old]} if isinstance(old, str) and old in RENAMED else known


def _read_dataclass(expected: Any, value: Any, field: str) -> Any:
    require(value, isinstance(value, dict), f"the fields of a {expected.__name__}", field)
    prefix = f"{field}." if field else ""
    annotations = field_types(expected)
    older = {name: ADDED_LATER[prefix + name] for name in annotations if prefix + name in ADDED_LATER}
    value = {**older, **value}
    unknown, missing = (min(map(str, names), default=None) for names in _differing(value, annotations))
    every = f"the fields of a {expected.__name__} ({', '.join(annotations)})"
    require(unknown, unknown is None, every, field)
    if missing is not None:
        raise ValueError(f"{field}{': ' if field else ''}expected {every}, found no {missing!r}")
    read = {name: _read(annotations[name], one, prefix + name) for name, one in value.items()}
    try:
        return expected(**read)
    except ValueError as error:  # the fields are inconsistent
        raise ValueError(f"{prefix.removesuffix('.')}{': ' if prefix else ''}{error}") from error


def _differing(value: dict[str, Any], annotations: dict[str, Any]) -> tuple[set[str], set[str]]:
    return set(value) - set(annotations), set(annotations) - set(value)


def _member(members: tuple[Any, ...], value: Any, field: str) -> Any:
    """The member of a union that fits a value. Several configurations are distinguished by their `kind`."""
    configs: dict[str, Any] = {member.kind: member for member in members if is_config(member)}
    if not configs:
        return next(member for member in members if member is not types.NoneType)
    names = " or ".join(member.__name__ for member in configs.values())
    require(value, isinstance(value, dict), f"the fields of a {names}", field)
    kind = value.get("kind")
    require(kind, isinstance(kind, str) and kind in configs, f"a kind, {' or '.join(configs)}", field)
    return configs[kind]
