"""Checks of configurations and arguments: the annotation of a field defines the values that it accepts.

A configuration is a frozen dataclass whose `__post_init__` calls `check_fields`. Types, choices (`Literal`), tuples and
`None` have their usual meaning. A number must be finite and must not be a bool, and `Bounds` may restrict its range.
"""

import dataclasses
import functools
import math
import os
import sys
import types
import typing
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple


class Bounds(NamedTuple):
    """Range of numbers that a field accepts: from `least` to `most`, and greater than `above`."""

    least: float = -math.inf
    most: float = math.inf
    above: float = -math.inf

    def __contains__(self, value: Any) -> bool:
        return self.least <= value <= self.most and value > self.above

    def __str__(self) -> str:
        limits = {"above": self.above, "from": self.least, "up to": self.most}
        texts = [f"{word} {limit:.12g}" for word, limit in limits.items() if math.isfinite(limit)]
        return " ".join(["a number", *texts])


Size = Annotated[int, Bounds(1, 2**20)]
"""Number of cells, channels or tokens. The upper bound rejects typing errors: such sizes fit into no memory."""
SizeOrZero = Annotated[int, Bounds(0, 2**20)]
Sizes = tuple[Size, ...]
Depths = tuple[Annotated[int, Bounds(1, 64)], ...]
"""Number of blocks of each stage."""
Count = Annotated[int, Bounds(1, 2**53)]
CountOrZero = Annotated[int, Bounds(0, 2**53)]
Positive = Annotated[float, Bounds(above=0)]
NotNegative = Annotated[float, Bounds(0)]
Share = Annotated[float, Bounds(0, 1)]
Degrees = Annotated[float, Bounds(0, 360)]


def check_fields(config: Any) -> None:
    """Raise ValueError if a field has an invalid value. The message has the field, the expected and the found value."""
    for name, annotation in field_types(type(config)).items():
        check_value(getattr(config, name), annotation, f"{type(config).__name__}.{name}")


@functools.cache
def field_types(config: type) -> dict[str, Any]:
    """Return the annotation of every field of a dataclass, by name."""
    return typing.get_type_hints(config, include_extras=True)


def is_config(annotation: Any) -> bool:
    """Whether a field with this annotation holds a nested configuration."""
    return isinstance(annotation, type) and dataclasses.is_dataclass(annotation)


def has_bounds(annotation: Any) -> bool:
    """Whether a field with this annotation holds numbers within `Bounds`."""
    return any(isinstance(part, Bounds) or has_bounds(part) for part in typing.get_args(annotation))


def check_value(value: Any, annotation: Any, field: str) -> None:
    """Raise ValueError, whose message begins with the name `field`, if the value does not fit the annotation."""
    read_value(value, annotation, field, json=False)


def read_value(value: Any, annotation: Any, field: str, *, json: bool = True) -> Any:
    """Convert a JSON value to the annotated type of a field: lists to tuples, strings to paths, integers to floats.

    With `json=False`, the value must have the type already. Numbers must be finite. Raises ValueError, with the name of
    the `field`, if the value does not fit the annotation.
    """
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        result = read_value(value, arguments[0], field, json=json)
        for metadata in arguments[1:]:
            if isinstance(metadata, Bounds):
                require(value, abs(result) <= sys.float_info.max, "a finite number", field)
                require(value, result in metadata, str(metadata), field)
        return result
    if origin in (typing.Union, types.UnionType):
        return _read_union(value, arguments, field, json=json)
    if origin is tuple:
        require(value, isinstance(value, list | tuple if json else tuple), "a list", field)
        item_types = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        require(value, len(value) == len(item_types), f"a list of {len(item_types)}", field)
        return tuple(read_value(item, type_, field, json=json) for item, type_ in zip(value, item_types, strict=True))
    if annotation is float:
        require(value, isinstance(value, int | float) and type(value) is not bool, "a value of type float", field)
        require(value, abs(value) <= sys.float_info.max, "a finite number", field)  # works for integers of any size
        return float(value) if json else value
    if origin is Literal:
        is_choice = any(type(value) is type(choice) and value == choice for choice in arguments)
        require(value, is_choice, f"one of {', '.join(map(repr, arguments))}", field)
    elif is_config(annotation):
        require(value, isinstance(value, annotation), f"the fields of a {annotation.__name__}", field)
    else:
        value_type = str if annotation is Path else annotation
        expected = "null" if value_type is types.NoneType else f"a value of type {value_type.__name__}"
        require(value, type(value) is value_type, expected, field)
    return Path(value) if annotation is Path else value


def require(value: Any, fits: bool, expected: str, field: str) -> None:
    """Raise ValueError with the field, what is expected, and the value in at most 60 characters, unless `fits`."""
    if not fits:
        found = repr(value)
        shown = found if len(found) <= 60 else f"{found[:57]}..."
        raise ValueError(f"{field}{': ' if field else ''}expected {expected}, found {shown}")


def _read_union(value: Any, members: tuple[Any, ...], field: str, *, json: bool) -> Any:
    """Convert a value to the first type of a union that accepts it.

    If none does, raise ValueError. The message "FIELD: expected A or B, found VALUE" joins those of the types but None.
    """
    if value is None and types.NoneType in members:
        return None
    expected, prefix, found = [], "", ""
    for member in (member for member in members if member is not types.NoneType):
        try:
            return read_value(value, member, field, json=json)
        except ValueError as error:
            prefix, _, rest = str(error).partition("expected ")
            expected_type, _, found = rest.rpartition(", found ")
            expected.append(expected_type)
    expected_types = " or ".join(expected).replace("or the fields of a ", "or ")
    raise ValueError(f"{prefix}expected {expected_types}, found {found}")


def check_is(value: Any, kind: type, *, by: str) -> None:
    """Raise TypeError if `value` is not of type `kind`. `by` is the function of `sglpr_jax` that returns this type."""
    if not isinstance(value, kind):
        raise TypeError(f"expected a {kind.__name__}, found {value_or_type(value)}; sglpr_jax.{by} returns one")


def value_or_type(value: Any) -> str:
    """The value itself if it is a string or path, otherwise its type."""
    return f"{value!r}" if isinstance(value, str | os.PathLike) else f"a {type(value).__name__}"
