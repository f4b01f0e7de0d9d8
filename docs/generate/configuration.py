"""The page of the configuration: every field with its default, and what each preset sets."""

import dataclasses
import inspect
import runpy
import typing
from pathlib import Path
from typing import Any

from fields import Field, fields_of, paragraph, table

from sglpr_jax.training.config import TrainConfig

HEAD = """# Configuration

A training run is told everything by one `TrainConfig`, and a model is described by the `ModelConfig` within it. Every
field can be set in a preset, a file of `configs/`, and on the command line: `bin/train --optimizer.learning-rate 1e-4`,
`bin/train --model.head.cbam False`. A run writes all of them to its `config.json`. This page is made from the code.

`bin/train --preset paper --dump-config` prints every field as JSON. `bin/train --config mine.json` reads such a file,
also with some of the fields only. The file overrides the preset, and flags override the file.
"""


def configuration_page(root: Path) -> str:
    """Every configuration that a training run has, and the presets."""
    paths = {cls: path for cls, path in reversed(_configurations(TrainConfig, ""))}
    sections = [_section(cls, path) for cls, path in reversed(paths.items())]
    presets = [_preset(path) for path in sorted((root / "configs").glob("*.py"))]
    return "\n".join([HEAD, *sections, "# Presets\n", *presets])


def _configurations(cls: type, path: str) -> list[tuple[type, str]]:
    """A configuration and all within it, with the dotted name of each on the command line."""
    found = [(cls, path)]
    for field in fields_of(cls):
        for part in _parts(field.type):
            found += _configurations(part, f"{path}{field.name.replace('_', '-')}.")
    return found


def _parts(annotation: Any) -> list[type]:
    """The dataclasses that a field may hold."""
    parts = typing.get_args(annotation) or (annotation,)
    return [part for part in parts if dataclasses.is_dataclass(part)]


def _section(cls: type, path: str) -> str:
    about = "\n\n".join(map(paragraph, (inspect.getdoc(cls) or "").split("\n\n")))
    rows = [_row(field, path) for field in fields_of(cls)]
    return "\n".join([f"## {cls.__name__}\n", about, "", table(("field", "default", "meaning"), rows), ""])


def _row(field: Field, path: str) -> tuple[str, str, str]:
    parts = _parts(field.type)
    links = " or ".join(f"[{part.__name__}](#{part.__name__.lower()})" for part in parts)
    default = type(field.default).__name__ if parts else repr(field.default)
    text = f"{links}. {field.text}".strip() if parts else field.text
    return f"`--{path}{field.name.replace('_', '-')}`", f"`{default}`", text


def _preset(path: Path) -> str:
    loaded = runpy.run_path(str(path))
    about = [paragraph(text) for text in loaded["__doc__"].split("\n\n")]
    default = _flat(TrainConfig())
    changed = {name: value for name, value in _flat(loaded["CONFIG"]).items() if default.get(name, ...) != value}
    rows = [(f"`{name}`", f"`{value!r}`") for name, value in changed.items()]
    return "\n".join([f"## {path.stem}\n", "\n\n".join(about), "", table(("field", "value"), rows), ""])


def _flat(config: Any, path: str = "") -> dict[str, Any]:
    flat = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        flat |= _flat(value, f"{path}{field.name}.") if dataclasses.is_dataclass(value) else {path + field.name: value}
    return flat
