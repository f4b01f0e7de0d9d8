"""Training presets: Python files in configs/ that define CONFIG."""

import runpy
from pathlib import Path

from sglpr_jax.training.config import TrainConfig

_PACKAGE = Path(__file__).resolve().parents[1]
_FOLDERS = (_PACKAGE / "configs", _PACKAGE.parent / "configs")  # the first in a wheel, the second in a checkout


def preset_names() -> tuple[str, ...]:
    """Return the names of all presets."""
    return tuple(sorted(path.stem for folder in _FOLDERS for path in folder.glob("*.py")))


def load_preset(name: str) -> TrainConfig:
    """Return the configuration of a preset, or of your own Python file that defines CONFIG.

    Raises ValueError if the file does not exist or fails.
    """
    paths = [Path(name)] if name.endswith(".py") else [folder / f"{name}.py" for folder in _FOLDERS]
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        raise ValueError(f"no preset {name!r}: expected a .py file or one of {', '.join(preset_names())}")
    try:
        config = runpy.run_path(str(path)).get("CONFIG")
    except Exception as error:  # a user's file may raise anything
        raise ValueError(f"{path}: expected a preset, found one that fails: {type(error).__name__}: {error}") from error
    if not isinstance(config, TrainConfig):
        raise ValueError(f"{path}: expected CONFIG, a TrainConfig, found {type(config).__name__}")
    return config


preset = load_preset
"""The public name, `sglpr_jax.preset`."""
