"""The fields of a dataclass as a reader wants to see them: name, type, default, and the text below each."""

import ast
import dataclasses
import inspect
import textwrap
import typing
from collections.abc import Iterator
from typing import Any, NamedTuple


class Field(NamedTuple):
    """One field."""

    name: str
    annotation: str
    """As it is written in the source."""
    type: Any
    default: Any
    """`dataclasses.MISSING` where it must be given."""
    text: str
    """The string below the field, on one line; empty where there is none."""


def fields_of(cls: type) -> list[Field]:
    """Return the fields of a dataclass in their order, those of its bases too."""
    written = {name: found for base in reversed(cls.__mro__) for name, found in _written(base)}
    types = typing.get_type_hints(cls, include_extras=True)
    return [
        Field(field.name, written[field.name][0], types[field.name], _default(field), written[field.name][1])
        for field in dataclasses.fields(cls)
    ]


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A Markdown table; bars within a cell are escaped."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def paragraph(text: str) -> str:
    """A docstring's text on one line."""
    return " ".join(text.split())


def _default(field: dataclasses.Field) -> Any:
    missing = field.default_factory is dataclasses.MISSING
    return field.default if missing else field.default_factory()


def _written(cls: type) -> Iterator[tuple[str, tuple[str, str]]]:
    """Name, annotation and text of every field in the source of one class."""
    if not dataclasses.is_dataclass(cls):
        return
    body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body
    for i, node in enumerate(body):
        if isinstance(node, ast.AnnAssign):
            below = body[i + 1].value if i + 1 < len(body) and isinstance(body[i + 1], ast.Expr) else None
            text = paragraph(str(below.value)) if isinstance(below, ast.Constant) else ""
            yield node.target.id, (ast.unparse(node.annotation), text)
