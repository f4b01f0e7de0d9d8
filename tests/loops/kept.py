"""Frames of a search without a network, for its checkpoint directory."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from sglpr_jax.loops import unfinished
from sglpr_jax.loops.candidates import Candidate, CandidateFinder
from sglpr_jax.loops.pose_search import Peak
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.loops.verification import Alignment
from sglpr_jax.retrieval.index import Index

WANTED = {"format": unfinished.FORMAT, "name": "08", "recording": "a"}


def finder_of(**stored: Any) -> CandidateFinder:
    """A finder without a network."""
    finder = object.__new__(CandidateFinder)
    vars(finder).update(stored)
    return finder


def fake_finder(seed: int = 0, frames: int = 5) -> CandidateFinder:
    """What a finder stores of some frames, drawn at random; the second frame has no scan."""
    draw, index = np.random.default_rng(seed), Index.empty(4, weights_hash="w")
    index.add(draw.normal(size=(frames, 4)))
    images = list(draw.integers(0, 255, (frames, 6, 6), np.uint8))
    links = [None, *(Peak(*draw.normal(size=6)) for _ in range(frames - 1))]
    return finder_of(index=index, images=images, missing=[1], links=links)


def fake_candidates(seed: int = 0) -> list[Candidate]:
    draw = np.random.default_rng(seed)
    x, y, yaw = map(jnp.asarray, draw.normal(size=3))
    evidence = Evidence(*map(np.asarray, draw.normal(size=len(Evidence._fields))))
    return [Candidate(4, 1, Alignment(x, y, yaw, jnp.eye(3), jnp.array(0.5), jnp.array(0.4)), evidence)]


def recalled(folder: Path, wanted: dict) -> list:
    """The frames that a checkpoint directory gives back."""
    finder, found = finder_of(index=Index.empty(4, weights_hash="w")), []

    def add(seen, compared):
        found.append((seen, compared))
        finder.index.add(np.zeros(4) if seen is None else seen.descriptor)

    kept = unfinished.Unfinished.opened(folder, wanted)
    kept.recall(finder, None, add, missing=True)
    return found


def keep(folder: Path, wanted: dict, seed: int = 0) -> Path:
    unfinished.Unfinished.opened(folder, wanted).keep(fake_finder(seed), fake_candidates(seed), all=True)
    return folder / "000000.safetensors"
