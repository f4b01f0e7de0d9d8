"""Settings of a command: the defaults of its dataclass < a preset < a JSON file (`--config`) < the command line.

The help of a command lists its flags. Settings of nested configurations, such as `--candidates.recent-m`, are accepted
on the command line and in the file, but not listed: `--dump-config` prints all settings as such a file.
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
    """Print all settings as JSON and exit. Nested ones are listed only there; set them as --candidates.recent-m 60."""


def flag_values(command: Any) -> dict[str, Any]:
    """Return the values of all flags of a command as JSON values, by flag without the leading dashes."""
    values = {flag: value for flag, _, value in all_flags(type(command), vars(command))}
    return json.loads(json.dumps(values, default=str))


def record_command(command: Any, folder: Path) -> Path:
    """Write the values of all flags to command.json in `folder`, and return its path. Raises WriteError on failure."""
    write_json(folder / COMMAND_FILE, flag_values(command))
    return folder / COMMAND_FILE


def split_settings(command: type[T], arguments: Sequence[str] | None = None) -> tuple[T, list[str]]:
    """Take from a command line the settings with a dot in their names, which tyro does not parse here.

    Arguments:
      command: Dataclass of the command. The default of its field `config`, if any, is the preset of --preset.
      arguments: Command line without the name. None: that of this process.

    Returns:
      The command with the values of preset, --config file and these settings, and the other arguments. Required fields
      without a value are `tyro.MISSING`.

    Raises FileNotFoundError if there is no file, and ValueError, which names the file or setting that is invalid.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)  # these flags set defaults of the others
    parser.add_argument("--config", type=Path)
    parser.add_argument("--preset")
    first_flags, _ = parser.parse_known_args(arguments)
    file: Any = first_flags.config
    file_values = {} if file is None else read_json(file)
    require(file_values, isinstance(file_values, dict), "an object with a value for each flag", str(file))
    fields = {field.name: _default_of(field) for field in dataclasses.fields(command)}  # type: ignore[arg-type]
    if "config" in fields:
        from sglpr_jax.training.presets import load_preset  # slow import, not needed by most commands

        if first_flags.preset is None and "preset" in file_values:
            with naming(f"{file}: preset"):
                fields["config"] = load_preset(read_value(file_values["preset"], str, ""))
        else:
            fields["config"] = load_preset(first_flags.preset or fields["preset"])
    if file_values:
        with naming(str(file)):
            fields = _replace_settings(command, fields, file_values)
    settings, other_arguments = _split_dotted(arguments, command, fields)
    if settings:
        fields = _replace_settings(command, fields, settings, dashes="--")
    default = object.__new__(command)  # the constructor would reject `tyro.MISSING`
    vars(default).update(fields)
    return default, other_arguments


def hide_nested(command: Any) -> None:
    """Keep the settings of nested configurations, whose flags have a dot, out of the help of a command."""
    for name, annotation in field_types(type(command)).items():
        value = getattr(command, name)
        if dataclasses.is_dataclass(value):
            if _omits_name(annotation):
                hide_nested(value)
            else:
                tyro.conf.configure(tyro.conf.Suppress)(type(value))


def _default_of(field: dataclasses.Field) -> Any:
    """Return the default of a field, or `tyro.MISSING` if it is required."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return tyro.MISSING if field.default is dataclasses.MISSING else field.default


def _split_dotted(arguments: list[str], command: type, fields: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return the settings with a dot in their names (--candidates.recent-m 50) by name, and the other arguments."""
    list_flags = {flag for flag, annotation, _ in all_flags(command, fields) if typing.get_origin(annotation) is tuple}
    settings, other_arguments, remaining = {}, [], list(arguments)
    while remaining:
        argument = remaining.pop(0)
        name, equals_sign, text = argument.partition("=")
        flag = name.removeprefix("--")
        if not name.startswith("--") or "." not in flag:
            other_arguments.append(argument)
            continue
        texts = [text] if equals_sign else []
        while remaining and not remaining[0].startswith("--") and (not texts or flag in list_flags):
            texts.append(remaining.pop(0))
        values = [_json_value(text) for text in texts]
        settings[flag] = values[0] if len(values) == 1 and flag not in list_flags else values
    return settings, other_arguments


def _json_value(text: str) -> Any:
    """Parse a value of the command line as JSON or as True, False or None of Python. Other values are texts."""
    try:
        return json.loads(text)
    except ValueError:
        return {"True": True, "False": False, "None": None}.get(text, text)


def _replace_settings(
    command: type, fields: Mapping[str, Any], settings: Mapping[str, Any], *, dashes: str = ""
) -> dict[str, Any]:
    """Return the fields of a command, by name, with the values of `settings`, which are by flag.

    Raises ValueError if a setting does not exist or a value does not fit it. The message names the setting, after
    `dashes`, the expected and the found value.
    """
    flags = [flag for flag, _, _ in all_flags(command, fields)]
    unknown = next((flag for flag in settings if flag not in flags), None)
    if unknown is not None:
        similar_flags = difflib.get_close_matches(unknown, flags, n=1)
        hint = f"; did you mean {dashes + similar_flags[0]!r}?" if similar_flags else ""
        raise ValueError(f"expected flags of the command, found {dashes + unknown!r}{hint}")
    return _replace_fields(command, fields, settings, "", dashes)


def _replace_fields(
    config: type, fields: Mapping[str, Any], settings: Mapping[str, Any], prefix: str, dashes: str
) -> dict[str, Any]:
    """Return the fields of a dataclass, by name, with the values of `settings`. Its flags begin with `prefix`."""
    replaced = dict(fields)
    for name, flag, annotation, value in _field_flags(config, fields, prefix):
        if is_config(type(value)):
            nested = _replace_fields(type(value), vars(value), settings, flag, dashes)
            # The configuration raises ValueError if its fields are inconsistent.
            with naming(flag.removesuffix(".")) if flag else contextlib.nullcontext():
                replaced[name] = dataclasses.replace(value, **nested)
        elif flag in settings:
            replaced[name] = read_value(settings[flag], annotation, dashes + flag)
    return replaced


def all_flags(config: type, fields: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield flag, annotation and value of all fields of a dataclass and of the configurations in it."""
    for _, flag, annotation, value in _field_flags(config, fields, prefix):
        if is_config(type(value)):
            yield from all_flags(type(value), vars(value), flag)
        else:
            yield flag, annotation, value


def _field_flags(config: type, fields: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, str, Any, Any]]:
    """Yield name, flag, annotation and value of each field. The flag of a configuration is the prefix of its flags."""
    for name, annotation in field_types(config).items():
        flag = prefix + name.replace("_", "-")
        if is_config(type(fields[name])):
            flag = prefix if _omits_name(annotation) else f"{flag}."
        yield name, flag, annotation, fields[name]


def _omits_name(annotation: Any) -> bool:
    """Return whether the flags of a nested configuration do not begin with the name of its field."""
    tyro_marks = getattr(annotation, "__metadata__", ())
    return tyro.conf.OmitArgPrefixes in tyro_marks or any(getattr(mark, "name", None) == "" for mark in tyro_marks)
