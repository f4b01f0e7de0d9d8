"""Folder of a run: its settings and environment. A run can only be resumed with the same settings."""

import contextlib
import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sglpr_jax.files import alone_in, read_json, remove_half_written, write_json
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.environment import note_environment

CONFIG_FILE = "config.json"


@contextlib.contextmanager
def claimed(
    folder: Path, config: TrainConfig, settings: Mapping[str, Any], *, resume: bool, made: int = 0
) -> Iterator[None]:
    """Lock a run's folder for this process while the block runs.

    The block starts with the configuration and the `settings` written to the folder, and without incomplete files of
    killed processes.

    Arguments:
      folder: Folder of the run.
      config: Configuration of the run.
      settings: Further entries of config.json.
      resume: Continue the run in the folder.
      made: Number of finished steps of that run.

    Raises:
      FileExistsError: The folder already has a run, and `resume` is false.
      BlockingIOError: Another process trains in the folder.
      ValueError: `config.steps` is less than `made`, or settings differ (see `require_same_settings`).
      FileNotFoundError: There is no run to resume.
    """
    path = folder / CONFIG_FILE
    if resume:
        require_same_settings(folder, config, settings)
        _require_steps(folder, config, made)
    folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder):
        if path.exists() and not resume:
            raise FileExistsError(
                f"{folder}: there is a run already; resume it (--resume) or choose another folder (--out)"
            )
        remove_half_written(folder)
        write_json(path, _as_json(config, settings))
        note_environment(folder, seed=config.seed)
        yield


def require_same_settings(folder: Path, config: TrainConfig, settings: Mapping[str, Any]) -> None:
    """Check that the run in `folder` has this configuration and these settings. The number of steps may differ.

    Raises FileNotFoundError if there is no run, and ValueError with the names of the settings that differ.
    """
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a run to resume, found none")
    different = sorted(_differences(read_json(path), _as_json(config, settings)) - {"config.steps"})
    if different:
        raise ValueError(f"{path}: expected the settings of the run to resume, found others: {', '.join(different)}")


def _require_steps(folder: Path, config: TrainConfig, made: int) -> None:
    if config.steps < made:
        raise ValueError(f"{folder}: expected at least the {made} steps that are already done, found {config.steps}")


def _as_json(config: TrainConfig, settings: Mapping[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps({**settings, "config": dataclasses.asdict(config)}, default=str))


def _differences(a: Any, b: Any, prefix: str = "") -> set[str]:
    if not (isinstance(a, dict) and isinstance(b, dict)):
        return set() if a == b else {prefix.removesuffix(".")}
    return {name for key in a.keys() | b.keys() for name in _differences(a.get(key), b.get(key), f"{prefix}{key}.")}
