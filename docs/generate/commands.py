"""The page of the commands: what each does, its examples and its flags, from the dataclass that its parser reads."""

import dataclasses
import inspect
import re

from fields import Field, fields_of, paragraph, table

from sglpr_jax.cli.__main__ import COMMANDS, load_command
from sglpr_jax.cli.config_file import ConfigFlags

HEAD = """# Commands

Each command stands in `bin/`, and after `pip install` as `sglpr-NAME`. `--help` prints the same. This page is made from
the parsers.

Every command also has these flags:

{common}
"""

COLUMNS = ("flag", "default", "meaning")


def commands_page() -> str:
    """All commands, by name."""
    head = HEAD.format(common=table(COLUMNS, [_row(field) for field in fields_of(ConfigFlags)]))
    return "\n".join([head, *(_section(name, load_command(name)[0]) for name in COMMANDS)])


def _section(name: str, command: type) -> str:
    about, _, examples = (inspect.getdoc(command) or "").partition("Example")
    lines = [f"## bin/{name}", "", about.strip(), ""]
    commands = [
        re.sub(r"\s{2,}(?=[^#\s])", "    # ", shown) for shown in re.findall(r"bin/.*$", examples, re.MULTILINE)
    ]
    if commands:
        lines += ["```bash", *commands, "```", ""]
    return "\n".join([*lines, table(COLUMNS, [_row(field) for field in _flags(command)]), ""])


def _flags(command: type) -> list[Field]:
    """The fields of a command, with those of the options that several commands share in their place."""
    return [flag for field in fields_of(command) for flag in _expanded(field)]


def _expanded(field: Field) -> list[Field]:
    """A field, or the fields of the options in it, with its name as a prefix. Those of a preset have their own page."""
    if not dataclasses.is_dataclass(field.default) or field.name == "config":
        return [field]
    prefix = "" if "OmitArgPrefixes" in field.annotation else f"{field.name}."
    nested = [flag for one in fields_of(type(field.default)) for flag in _expanded(one)]
    return [one._replace(name=prefix + one.name) for one in nested]


def _row(field: Field) -> tuple[str, str, str]:
    if dataclasses.is_dataclass(field.default):
        return "any field of the configuration", "the preset's", "See [Configuration](configuration.md)."
    positional = "Positional" in field.annotation
    flag = field.name.upper() if positional else "--" + field.name.replace("_", "-")
    return f"`{flag}`", _shown(field.default), paragraph(field.text)


def _shown(default: object) -> str:
    if default is dataclasses.MISSING:
        return "required"
    if default is None or default is False or default == ():
        return ""
    return f"`{' '.join(map(str, default)) if isinstance(default, tuple) else default}`"
