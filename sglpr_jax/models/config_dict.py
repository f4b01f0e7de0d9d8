"""Conversion of the plain values of a JSON file to a model configuration, with a check of every field."""

import typing
from pathlib import Path
from typing import Any

from sglpr_jax.fields import field_types, is_config, read_value, require
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
    """Converts a value to a field's type, and dictionaries to dataclasses."""
    value = _of_today(value, f"{field}." if field else "")
    if is_config(annotation):
        return _read_dataclass(annotation, value, field)
    members = typing.get_args(annotation)
    if any(map(is_config, members)):
        return _read(_member(members, value, field), value, field)
    return read_value(value, annotation, field)


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
    """The configuration of a union that has the `kind` of the value."""
    configs: dict[str, Any] = {member.kind: member for member in members}
    names = " or ".join(member.__name__ for member in members)
    require(value, isinstance(value, dict), f"the fields of a {names}", field)
    kind = value.get("kind")
    require(kind, isinstance(kind, str) and kind in configs, f"a kind, {' or '.join(configs)}", field)
    return configs[kind]
