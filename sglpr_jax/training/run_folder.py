"""A run's folder: begun once, with its settings and environment, and resumed with the same settings only."""

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
    """Be the only process that trains in a run's folder, for as long as the block lasts.

    The configuration and further `settings` are written into it; what a killed process left is removed. `made` are the
    steps that the run to `resume` has made. Raises FileExistsError where there is a run already and this one is not to
    resume it, BlockingIOError where another process trains there, ValueError where fewer steps are asked for than are
    made; otherwise as `require_same_settings`.
    """
    path = folder / CONFIG_FILE
    if resume:
        require_same_settings(folder, config, settings)
        _require_steps(folder, config, made)
    folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder):
        if path.exists() and not resume:
            raise FileExistsError(
                f"{folder}: there is a run already; go on with it (--resume), or choose another folder (--out)"
            )
        remove_half_written(folder)
        write_json(path, _as_json(config, settings))
        note_environment(folder, seed=config.seed)
        yield


def require_same_settings(folder: Path, config: TrainConfig, settings: Mapping[str, Any]) -> None:
    """See that the run in `folder` was begun with this configuration and settings, the number of steps apart.

    Raises FileNotFoundError where there is no run, ValueError, naming them, where settings differ.
    """
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a run to resume, found none")
    different = sorted(_differences(read_json(path), _as_json(config, settings)) - {"config.steps"})
    if different:
        raise ValueError(
            f"{path}: expected the same settings as before to resume, found others: {', '.join(different)}"
        )


def _require_steps(folder: Path, config: TrainConfig, made: int) -> None:
    if config.steps < made:
        raise ValueError(f"{folder}: expected steps of at least the {made} made, found {config.steps}")


def _as_json(config: TrainConfig, settings: Mapping[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps({**settings, "config": dataclasses.asdict(config)}, default=str))


def _differences(a: Any, b: Any, prefix: str = "") -> set[str]:
    if not (isinstance(a, dict) and isinstance(b, dict)):
        return set() if a == b else {prefix.removesuffix(".")}
    return {name for key in a.keys() | b.keys() for name in _differences(a.get(key), b.get(key), f"{prefix}{key}.")}
