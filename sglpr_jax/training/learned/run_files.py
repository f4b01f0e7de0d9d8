"""Files of a run: its settings, and its state between two steps, from which it can be resumed exactly."""

import contextlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from sglpr_jax.data.formats.tensors import tensors_as_bytes
from sglpr_jax.fields import CountOrNone, NotNegative, Positive, check_fields
from sglpr_jax.files import alone_in, read_json, remove_half_written, replacing, write_json
from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.methods.learned.weights_file import check_leaves, read_tensors
from sglpr_jax.models.weights import hash_of
from sglpr_jax.training.learned.inputs import Prepared
from sglpr_jax.training.learned.step import State

CONFIG_FILE = "config.json"
STATE_FILE = "state.safetensors"
METRICS_FILE = "metrics.jsonl"
SCORES_FILE = "scores.jsonl"
LIMITS = ("seconds", "images")
"""Settings that may differ when a run is resumed."""


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run, beside the recipe of its method."""

    learning_rate: Positive
    seed: CountOrNone = 0
    seconds: NotNegative = 3600.0
    """Training time in seconds. Scores and the compilation of the step do not count."""
    images: CountOrNone = 0
    """Number of images after which the training stops; 0: no limit."""

    def __post_init__(self):
        check_fields(self)


class Progressed(NamedTuple):
    """State of a run and what it cost."""

    state: State
    images: int
    """Number of images that the network has been trained with. An image counts each time that it is used."""
    seconds: float
    """Training time in seconds."""


@contextlib.contextmanager
def claimed(
    folder: Path, method: LearnedMethod, data: Prepared, settings: RunSettings, *, resume: bool
) -> Iterator[None]:
    """Lock a run's folder while the block runs, with the settings written to it.

    Raises:
      FileExistsError: The folder already has a run, and `resume` is false.
      FileNotFoundError: There is no run to resume.
      ValueError: The run to resume has other settings. The time and the number of images may differ.
      BlockingIOError: Another process trains in the folder.
    """
    path, config = folder / CONFIG_FILE, _as_json(method, data, settings)
    if resume and not path.is_file():
        raise FileNotFoundError(f"{path}: expected a run to resume, found none")
    if resume:
        _require_same(path, read_json(path), config)
    folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder):
        if path.exists() and not resume:
            raise FileExistsError(f"{folder}: there is a run already; resume it (--resume) or choose another --out")
        remove_half_written(folder)
        write_json(path, config)
        yield


def save_state(folder: Path, progressed: Progressed) -> None:
    """Write the state of a run, completely or not at all."""
    values = {name: np.asarray(leaf, order="C") for name, leaf in _by_path(progressed).items()}
    with replacing(folder / STATE_FILE) as temporary:
        temporary.write_bytes(tensors_as_bytes(values, {"sha256": hash_of(values)}))


def load_state(folder: Path, like: Progressed) -> Progressed:
    """Return the saved state, which has the structure of `like`, or `like` itself if no state was saved.

    Raises ValueError if the file is damaged or belongs to another network.
    """
    path = folder / STATE_FILE
    if not path.is_file():
        return like
    values, expected = read_tensors(path), _by_path(like)
    check_leaves(values, expected, source=path)
    found = jax.tree.unflatten(jax.tree.structure(like), [values[name] for name in expected])
    return Progressed(jax.device_put(found.state), int(found.images), float(found.seconds))


def _by_path(progressed: Progressed) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(progressed)
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def _as_json(method: LearnedMethod, data: Prepared, settings: RunSettings) -> dict[str, Any]:
    recipe = {name: value for name, value in asdict(method.recipe).items() if name != "learning_rates"}
    recordings = [{"name": one.name, "scans": len(one)} for one in data.recordings]
    config = {"method": method.name, "settings": asdict(settings), "recipe": recipe, "recordings": recordings}
    return json.loads(json.dumps(config))


def _require_same(path: Path, found: Any, expected: Mapping[str, Any]) -> None:
    """Raise ValueError, with the names of the settings that differ, unless the run has the expected ones."""
    found = _flat(found) if isinstance(found, dict) else {}
    wanted = _flat(expected)
    names = sorted(name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name))
    different = [name for name in names if name not in {f"settings.{limit}" for limit in LIMITS}]
    if different:
        raise ValueError(f"{path}: expected the settings of the run to resume, found others: {', '.join(different)}")


def _flat(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a configuration, with names like `settings.seed` for those of a nested one."""
    return {
        f"{name}.{inner}" if inner else name: value
        for name, part in config.items()
        for inner, value in (part.items() if isinstance(part, dict) else [("", part)])
    }
