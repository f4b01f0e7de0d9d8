"""Contenders of the comparison: what describes a recording, and what its training cost.

A contender is called by a handcrafted method (`scan-context`), shipped weights (`sglpr`), an untrained network
(`rinet@random:0`), or a folder of weights (`rinet-0`, `rinet-0/weights-4000`) in the folder of the runs.
`METHOD@FOLDER` applies another method with the same weights: `bevplace++@resnet34-netvlad-0`.
"""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path

import jax

import sglpr_jax
from sglpr_jax.data import Recording
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.learned.describe import apply_network
from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.methods.learned.weights_file import LAST, RANDOM, load_variables
from sglpr_jax.methods.method import Method, RecordMethod, Takes
from sglpr_jax.methods.registry import handcrafted, network, trained_method
from sglpr_jax.models.presets import model_preset
from sglpr_jax.models.sglpr import init
from sglpr_jax.training.learned.run_files import SCORES_FILE


@dataclasses.dataclass(frozen=True)
class Entry:
    """A contender."""

    name: str
    takes: Takes
    method: Callable[[Recording], Method]
    """Returns the method for the scans of a recording."""
    images: int | None = None
    """Number of images that it was trained with. None: not trained here."""
    seconds: float | None = None
    """Training time in seconds."""

    @property
    def file_name(self) -> str:
        """Name of its files."""
        return self.name.replace("/", "_").replace(":", "-")


def entry(name: str, runs: Path) -> Entry:
    """Return the contender called `name`.

    Raises FileNotFoundError if there is no method, weights or run of that name.
    """
    if name in HANDCRAFTED:
        return Entry(name, HANDCRAFTED[name].takes, lambda recording: handcrafted(name, recording, GRID))
    if name in sglpr_jax.shipped_weights():
        return Entry(name, "images", functools.partial(_constant, network(sglpr_jax.load(name))))
    method, _, weights = name.rpartition("@")
    if weights.startswith(RANDOM):
        return _untrained(name, method, weights)
    folder = runs / weights
    folder = folder if "/" in weights else _last(folder)
    about, seen = _about(folder), _seen(folder)
    if "method" not in about:
        return Entry(name, "images", functools.partial(_constant, network(sglpr_jax.load(folder))), *seen)
    own = LEARNED[about["method"]]
    other = LEARNED[method] if method else own
    made = trained_method(own, str(folder))
    made = made if other is own else _with_network(made, other, own, folder)
    return Entry(name, other.takes, functools.partial(_constant, made), *seen)


GRID = model_preset("sglpr").grid
"""Grid of handcrafted methods on images."""


def _constant(method: Method, recording: Recording) -> Method:
    return method


def _untrained(name: str, method: str, weights: str) -> Entry:
    if method in LEARNED:
        made = trained_method(LEARNED[method], weights)
        return Entry(name, LEARNED[method].takes, functools.partial(_constant, made), 0, 0.0)
    params = init(jax.random.key(int(weights.removeprefix(RANDOM))), preset=method)
    return Entry(name, "images", functools.partial(_constant, network(params)), 0, 0.0)


def _with_network(made: RecordMethod, other: LearnedMethod, own: LearnedMethod, folder: Path) -> RecordMethod:
    """Return the method `other` with the weights of `own`. The distance must be L2."""
    describe = functools.partial(apply_network, load_variables(folder, own), method=other)
    about = {"method": other.name, "weights": str(folder)}
    return dataclasses.replace(made, prepare=other.prepare, describe=describe, takes=other.takes, about=about)


def _last(run: Path) -> Path:
    """Return the folder of the last weights of a run."""
    return run / LAST if (run / LAST / "config.json").is_file() else run


def _about(folder: Path) -> dict:
    path = folder / "config.json"
    if not path.is_file():
        raise FileNotFoundError(f"{folder}: expected weights or the name of a method, found no config.json")
    return json.loads(path.read_text())


def _seen(folder: Path) -> tuple[int, float]:
    """Return the number of images and the training time of weights, from their file or the scores of the run."""
    about = _about(folder)
    if "images" in about:
        return about["images"], about["seconds"]
    lines = [json.loads(line) for line in (folder.parent / SCORES_FILE).read_text().splitlines()]
    named = folder.name.removeprefix(f"{LAST}-")
    line = next((one for one in lines if str(one["images"]) == named), lines[-1])
    return line["images"], line["seconds"]
