"""Defaults of the flags of a command: those of its dataclass, of a preset, and of a file (`--config`)."""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import tyro

from sglpr_jax.cli.config_file import read_flag_values, with_flag_values
from sglpr_jax.fields import read_value

T = TypeVar("T")


def default_command(
    command: type[T], arguments: list[str] | None = None, *, load_preset: Callable[[str], Any] | None = None
) -> T:
    """Return a command with its defaults. The file of --config overrides a preset, which overrides the dataclass.

    Arguments:
      command: Dataclass of the command.
      arguments: Command line without the name. None: that of this process.
      load_preset: Loads the default of the field `config`, given the value of --preset. None: no presets.

    Returns:
      A command, with `tyro.MISSING` for required fields that the file does not contain.

    Raises:
      ValueError: If the file or the preset is invalid.
    """
    file, preset = _early_flags(arguments)
    fields = {field.name: _default(field) for field in dataclasses.fields(command)}  # type: ignore[arg-type]
    values = {} if file is None else read_flag_values(file)
    if load_preset is not None and preset is None and "preset" in values:
        fields["config"] = _preset_in_file(values["preset"], load_preset, source=file)
    elif load_preset is not None:
        fields["config"] = load_preset(preset or fields["preset"])
    if file is not None:
        fields = with_flag_values(command, fields, values, source=file)
    made = object.__new__(command)  # the constructor takes no missing values
    vars(made).update(fields)
    return made


def _early_flags(arguments: list[str] | None) -> tuple[Path | None, str | None]:
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
