"""Flags of a command in a JSON file: `--dump-config` prints them, `--config` reads them, result folders record them."""

import dataclasses
import difflib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from sglpr_jax.fields import field_types, read_value, require

COMMAND_FILE = "command.json"
"""Record of the flags of a command, in the folder of its results."""


@dataclasses.dataclass(frozen=True)
class ConfigFlags:
    """Flags of every command."""

    config: Path | None = None
    """JSON file with values of flags, as printed by --dump-config. Flags on the command line override the file."""
    dump_config: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the values of all flags as JSON and exit."""


def flag_values(command: Any) -> dict[str, Any]:
    """Return the values of all flags of a command as JSON values, by flag without dashes."""
    values = {}

    def note(flag: str, _annotation: Any, value: Any) -> Any:
        values[flag] = _as_json(value)
        return value

    _visit(type(command), vars(command), note)
    return values


def record_command(command: Any, folder: Path) -> Path:
    """Write the values of all flags to `folder`. Returns the path. Raises WriteError if the file cannot be written."""
    from sglpr_jax.files import write_json  # slow import, not needed for --help

    write_json(folder / COMMAND_FILE, flag_values(command))
    return folder / COMMAND_FILE


def read_flag_values(path: Path) -> dict[str, Any]:
    """Read values by flag without dashes. Raises FileNotFoundError, or ValueError if the file has other content."""
    from sglpr_jax.files import read_json  # slow import, not needed for --help

    values = read_json(path)
    require(values, isinstance(values, dict), "an object with a value for each flag", str(path))
    return values


def with_flag_values(
    command: type, fields: Mapping[str, Any], values: Mapping[str, Any], *, source: Path
) -> dict[str, Any]:
    """Return the fields of a command, by name, with other values for some of its flags.

    Arguments:
      command: Dataclass of the command.
      fields: All fields of the command by name.
      values: JSON values, by flag without dashes.
      source: File of the values.

    Raises:
      ValueError: If a flag does not exist or a value does not fit it. The message names `source`, the flag, the
        expected and the found value.
    """
    from sglpr_jax.files import naming  # slow import, not needed for --help

    known = []

    def read(flag: str, annotation: Any, value: Any) -> Any:
        known.append(flag)
        return read_value(values[flag], annotation, flag) if flag in values else value

    with naming(source):
        changed = _visit(command, fields, read)
        _check_known(values, known)
    return changed


def _visit(
    config: type, fields: Mapping[str, Any], visit: Callable[[str, Any, Any], Any], prefix: str = ""
) -> dict[str, Any]:
    """Return the fields of a dataclass by name, with `visit(flag, annotation, value)` as the value of each flag."""
    visited = {}
    for name, annotation in field_types(config).items():
        flag, value = prefix + name.replace("_", "-"), fields[name]
        if dataclasses.is_dataclass(value):
            inner = prefix if _is_flat(annotation) else f"{flag}."
            nested = _visit(type(value), vars(value), visit, inner)
            visited[name] = _replaced(value, nested, inner)
        else:
            visited[name] = visit(flag, annotation, value)
    return visited


def _replaced(config: Any, fields: dict[str, Any], prefix: str) -> Any:
    """Replace the fields of a nested configuration. The message of an error begins with the prefix of its flags."""
    try:
        return dataclasses.replace(config, **fields)
    except ValueError as error:  # the fields are inconsistent
        raise ValueError(f"{prefix.removesuffix('.')}: {error}" if prefix else str(error)) from error


def _is_flat(annotation: Any) -> bool:
    """Whether the flags of a nested configuration do not begin with the name of its field."""
    marks = getattr(annotation, "__metadata__", ())
    return tyro.conf.OmitArgPrefixes in marks or any(getattr(mark, "name", None) == "" for mark in marks)


def _check_known(values: Mapping[str, Any], known: list[str]) -> None:
    unknown = next((flag for flag in values if flag not in known), None)
    if unknown is not None:
        near = difflib.get_close_matches(unknown, known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"expected flags of the command, found {unknown!r}{hint}")


def _as_json(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_as_json(one) for one in value]
    return str(value) if isinstance(value, Path) else value
