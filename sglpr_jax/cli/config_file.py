"""Settings of a command: the defaults of its dataclass < a preset < a JSON file (`--config`) < the command line.

The help of a command lists its flags. Settings of nested configurations, such as `--candidates.recent-m`, are accepted
on the command line and in the file, but not listed: `--dump-config` prints all settings as such a file. Folders of
results record them as command.json.
"""

import argparse
import contextlib
import dataclasses
import difflib
import json
import sys
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from sglpr_jax.fields import field_types, is_config, read_value, require
from sglpr_jax.files import naming, read_json, write_json

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
    values = {flag: value for flag, _, value in _flags(type(command), vars(command))}
    return json.loads(json.dumps(values, default=str))


def record_command(command: Any, folder: Path) -> Path:
    """Write the values of all flags to `folder`. Returns the path. Raises WriteError if the file cannot be written."""
    write_json(folder / COMMAND_FILE, flag_values(command))
    return folder / COMMAND_FILE


def with_defaults(command: type[T], arguments: Sequence[str] | None = None) -> tuple[T, list[str]]:
    """Return a command with its defaults, and the command line without the settings that are not listed by the help.

    The default of a field `config` is the preset that --preset names.

    Arguments:
      command: Dataclass of the command.
      arguments: Command line without the name. None: that of this process.

    Returns:
      A command, with `tyro.MISSING` for required fields that the file does not contain, and the other arguments.

    Raises:
      FileNotFoundError: If there is no file.
      ValueError: If the file, the preset or a setting is invalid. The message names the file or the setting.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)  # the two that set the other flags' defaults
    parser.add_argument("--config", type=Path)
    parser.add_argument("--preset")
    first_flags, _ = parser.parse_known_args(arguments)
    file: Any = first_flags.config
    values = {} if file is None else read_json(file)
    require(values, isinstance(values, dict), "an object with a value for each flag", str(file))
    fields = {field.name: _default(field) for field in dataclasses.fields(command)}  # type: ignore[arg-type]
    if "config" in fields:
        from sglpr_jax.training.presets import load_preset  # slow import, not needed by most commands

        in_file = first_flags.preset is None and "preset" in values
        with naming(f"{file}: preset") if in_file else contextlib.nullcontext():
            preset = read_value(values["preset"], str, "") if in_file else first_flags.preset or fields["preset"]
            fields["config"] = load_preset(preset)
    if values:
        with naming(str(file)):
            fields = _with_values(command, fields, values)
    settings, others = _split_settings(arguments, command, fields)
    if settings:
        fields = _with_values(command, fields, settings, dashes="--")
    default = object.__new__(command)  # the constructor takes no missing values
    vars(default).update(fields)
    return default, others


def hide_nested(command: Any) -> None:
    """Keep the settings of nested configurations, whose names have a dot, out of the help of a command."""
    for name, annotation in field_types(type(command)).items():
        value = getattr(command, name)
        if dataclasses.is_dataclass(value):
            if _is_flat(annotation):
                hide_nested(value)
            else:
                tyro.conf.configure(tyro.conf.Suppress)(type(value))


def _default(field: dataclasses.Field) -> Any:
    """Return the default of a field, or `tyro.MISSING` if it is required."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return tyro.MISSING if field.default is dataclasses.MISSING else field.default


def _split_settings(arguments: list[str], command: type, fields: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Take the settings with a dot in their names (--candidates.recent-m 50) out of a command line."""
    lists = {flag for flag, annotation, _ in _flags(command, fields) if typing.get_origin(annotation) is tuple}
    values, others, rest = {}, [], list(arguments)
    while rest:
        name, equals, text = (word := rest.pop(0)).partition("=")
        flag = name.removeprefix("--")
        if not name.startswith("--") or "." not in flag:
            others.append(word)
            continue
        texts = [text] if equals else []
        while rest and not rest[0].startswith("--") and (not texts or flag in lists):
            texts.append(rest.pop(0))
        words = [_json_value(text) for text in texts]
        values[flag] = words if flag in lists or len(words) != 1 else words[0]
    return values, others


def _json_value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return {"True": True, "False": False, "None": None}.get(text, text)


def _with_values(
    command: type, fields: Mapping[str, Any], values: Mapping[str, Any], *, dashes: str = ""
) -> dict[str, Any]:
    """Return the fields of a command, by name, with other values for some of its settings.

    Raises ValueError if a setting does not exist or a value does not fit it. The message names the setting, the
    expected and the found value.
    """
    flags = [flag for flag, _, _ in _flags(command, fields)]
    unknown = next((flag for flag in values if flag not in flags), None)
    if unknown is not None:
        near = difflib.get_close_matches(unknown, flags, n=1)
        hint = f"; did you mean {dashes + near[0]!r}?" if near else ""
        raise ValueError(f"expected flags of the command, found {dashes + unknown!r}{hint}")
    return _replace(command, fields, values, "", dashes)


def _replace(
    config: type, fields: Mapping[str, Any], values: Mapping[str, Any], prefix: str, dashes: str
) -> dict[str, Any]:
    """Return the fields of a dataclass by name, with the values of some flags. `prefix` begins its flags."""
    replaced = dict(fields)
    for name, flag, annotation, value in _named_flags(config, fields, prefix):
        if is_config(type(value)):
            nested = _replace(type(value), vars(value), values, flag, dashes)
            with naming(flag.removesuffix(".")) if flag else contextlib.nullcontext():  # fields may be inconsistent
                replaced[name] = dataclasses.replace(value, **nested)
        elif flag in values:
            replaced[name] = read_value(values[flag], annotation, dashes + flag)
    return replaced


def _flags(config: type, fields: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield flag, annotation and value of all fields of a dataclass and of the configurations in it."""
    for _, flag, annotation, value in _named_flags(config, fields, prefix):
        if is_config(type(value)):
            yield from _flags(type(value), vars(value), flag)
        else:
            yield flag, annotation, value


def _named_flags(config: type, fields: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, str, Any, Any]]:
    """Yield name, flag, annotation and value of each field. The flag of a configuration is the prefix of its flags."""
    for name, annotation in field_types(config).items():
        flag = prefix + name.replace("_", "-")
        if is_config(type(fields[name])):
            flag = prefix if _is_flat(annotation) else f"{flag}."
        yield name, flag, annotation, fields[name]


def _is_flat(annotation: Any) -> bool:
    """Whether the flags of a nested configuration do not begin with the name of its field."""
    marks = getattr(annotation, "__metadata__", ())
    return tyro.conf.OmitArgPrefixes in marks or any(getattr(mark, "name", None) == "" for mark in marks)
