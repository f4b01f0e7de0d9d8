"""Settings of a command: the defaults of its dataclass < a preset < a JSON file (`--config`) < the command line.

The help of a command lists its flags. Settings of nested configurations, such as `--candidates.recent-m`, are accepted
on the command line and in the file, but not listed: `--dump-config` prints all settings as such a file. Folders of
results record them as command.json.
"""

import argparse
import dataclasses
import difflib
import json
import sys
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from sglpr_jax.fields import field_types, read_value, require

T = TypeVar("T")
COMMAND_FILE = "command.json"
"""Record of the flags of a command, in the folder of its results."""


@dataclasses.dataclass(frozen=True)
class ConfigFlags:
    """Flags of every command."""

    config: Path | None = None
    """JSON file with settings, as printed by --dump-config. The command line overrides the file."""
    dump_config: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print all settings as JSON and exit. Those with a dot are not listed here; set them as --NAME VALUE."""


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


def with_defaults(
    command: type[T], arguments: Sequence[str] | None = None, *, load_preset: Callable[[str], Any] | None = None
) -> tuple[T, list[str]]:
    """Return a command with its defaults, and the command line without the settings that are not listed by the help.

    Arguments:
      command: Dataclass of the command.
      arguments: Command line without the name. None: that of this process.
      load_preset: Loads the default of the field `config`, given the value of --preset. None: no presets.

    Returns:
      A command, with `tyro.MISSING` for required fields that the file does not contain, and the other arguments.

    Raises:
      FileNotFoundError: If there is no file.
      ValueError: If the file, the preset or a setting is invalid. The message names the file or the setting.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    file, preset = _early_flags(arguments)
    fields = {field.name: _default(field) for field in dataclasses.fields(command)}  # type: ignore[arg-type]
    values = {} if file is None else _read_values(file)
    if load_preset is not None and preset is None and "preset" in values:
        fields["config"] = _preset_in_file(values["preset"], load_preset, source=file)
    elif load_preset is not None:
        fields["config"] = load_preset(preset or fields["preset"])
    if file is not None:
        from sglpr_jax.files import naming  # slow import, not needed for --help

        with naming(file):
            fields = _with_values(command, fields, values)
    settings, others = _split_settings(arguments, command, fields)
    if settings:
        fields = _with_values(command, fields, settings, dashes="--")
    made = object.__new__(command)  # the constructor takes no missing values
    vars(made).update(fields)
    return made, others


def hide_nested(command: Any) -> None:
    """Keep the settings of nested configurations, whose names have a dot, out of the help of a command."""
    for name, annotation in field_types(type(command)).items():
        value = getattr(command, name)
        if dataclasses.is_dataclass(value):
            if _is_flat(annotation):
                hide_nested(value)
            else:
                tyro.conf.configure(tyro.conf.Suppress)(type(value))


def _early_flags(arguments: list[str]) -> tuple[Path | None, str | None]:
    """Read --config and --preset before the other flags, because they set the defaults of the other flags."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--preset")
    early, _ = parser.parse_known_args(arguments)
    return early.config, early.preset


def _default(field: dataclasses.Field) -> Any:
    """Return the default of a field, or `tyro.MISSING` if it is required."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return tyro.MISSING if field.default is dataclasses.MISSING else field.default


def _preset_in_file(preset: Any, load_preset: Callable[[str], Any], *, source: Path | None) -> Any:
    """Load the preset that a file of --config names. The message of an error names the file."""
    from sglpr_jax.files import naming  # slow import, not needed for --help

    with naming(f"{source}: preset"):
        return load_preset(read_value(preset, str, ""))


def _read_values(path: Path) -> dict[str, Any]:
    """Read values by setting. Raises FileNotFoundError, or ValueError if the file has other content."""
    from sglpr_jax.files import read_json  # slow import, not needed for --help

    values = read_json(path)
    require(values, isinstance(values, dict), "an object with a value for each flag", str(path))
    return values


def _split_settings(arguments: list[str], command: type, fields: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Take the settings with a dot in their names (--candidates.recent-m 50) out of a command line."""
    annotations: dict[str, Any] = {}

    def note(flag: str, annotation: Any, value: Any) -> Any:
        annotations[flag] = annotation
        return value

    _visit(command, fields, note)
    values, others, rest = {}, [], list(arguments)
    while rest:
        name, _, given = (first := rest.pop(0)).partition("=")
        flag = name.removeprefix("--")
        if not name.startswith("--") or "." not in flag:
            others.append(first)
            continue
        texts = [given] if "=" in first else []
        annotation = annotations.get(flag)
        while rest and not rest[0].startswith("--") and (not texts or _is_list(annotation)):
            texts.append(rest.pop(0))
        values[flag] = _value_of(texts, annotation)
    return values, others


def _is_list(annotation: Any) -> bool:
    """Whether a setting takes several values."""
    return typing.get_origin(annotation) is tuple


def _value_of(texts: list[str], annotation: Any) -> Any:
    """JSON value of the words of a setting."""
    words = {"True": True, "False": False, "None": None}

    def read(text: str) -> Any:
        try:
            return words[text] if text in words else json.loads(text)
        except ValueError:
            return text

    values = [read(text) for text in texts]
    return values if _is_list(annotation) or len(values) != 1 else values[0]


def _with_values(
    command: type, fields: Mapping[str, Any], values: Mapping[str, Any], *, dashes: str = ""
) -> dict[str, Any]:
    """Return the fields of a command, by name, with other values for some of its settings.

    Raises ValueError if a setting does not exist or a value does not fit it. The message names the setting, the
    expected and the found value.
    """
    known = []

    def read(flag: str, annotation: Any, value: Any) -> Any:
        known.append(flag)
        return read_value(values[flag], annotation, dashes + flag) if flag in values else value

    changed = _visit(command, fields, read)
    _check_known(values, known, dashes)
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


def _check_known(values: Mapping[str, Any], known: list[str], dashes: str) -> None:
    unknown = next((flag for flag in values if flag not in known), None)
    if unknown is not None:
        near = difflib.get_close_matches(unknown, known, n=1)
        hint = f"; did you mean {dashes + near[0]!r}?" if near else ""
        raise ValueError(f"expected flags of the command, found {dashes + unknown!r}{hint}")


def _as_json(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_as_json(one) for one in value]
    return str(value) if isinstance(value, Path) else value
