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
from sglpr_jax.data.recording import Recording
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.learned.describe import apply_network
from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.methods.learned.weights_file import LAST, RANDOM, load_variables, method_of
from sglpr_jax.methods.method import Method, RecordMethod, Takes
from sglpr_jax.methods.registry import handcrafted, method_with_weights, network, trained_method
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.sglpr import init
from sglpr_jax.reproduce.compared import content_of
from sglpr_jax.training.learned.run_files import SCORES_FILE

GRID = model_preset("sglpr").grid
"""Grid of handcrafted methods on images."""


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
    seen, own = _seen(folder), method_of(folder)
    if own is None or not method:
        made = method_with_weights(str(folder))
        return Entry(name, content_of(str(folder)), functools.partial(_constant, made), *seen)
    made = _with_network(LEARNED[method], LEARNED[own], folder)
    return Entry(name, made.takes, functools.partial(_constant, made), *seen)


def _constant(method: Method, recording: Recording) -> Method:
    return method


def _untrained(name: str, method: str, weights: str) -> Entry:
    if method in LEARNED:
        made = trained_method(LEARNED[method], weights)
        return Entry(name, LEARNED[method].takes, functools.partial(_constant, made), 0, 0.0)
    params = init(jax.random.key(int(weights.removeprefix(RANDOM))), preset=method)
    return Entry(name, "images", functools.partial(_constant, network(params)), 0, 0.0)


def _with_network(method: LearnedMethod, own: LearnedMethod, folder: Path) -> RecordMethod:
    """Return a method with the weights of another one, `own`, which has the same parameters and the distance L2."""
    describe = functools.partial(apply_network, load_variables(folder, own), method=method)
    about = {"method": method.name, "weights": str(folder)}
    made = trained_method(own, str(folder))
    return dataclasses.replace(made, prepare=method.prepare, describe=describe, takes=method.takes, about=about)


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
