"""Frames of a search without a network, for its checkpoint directory."""

from pathlib import Path

import numpy as np

from sglpr_jax.loops import checkpoint
from sglpr_jax.loops.candidates import CandidateFinder, Compared
from sglpr_jax.loops.comparison import NO_FITS, Fits
from sglpr_jax.loops.keyframes import Seen, StoredScans
from sglpr_jax.odometry.bev_odometry import Link
from sglpr_jax.registration.bev_search import Peak
from sglpr_jax.retrieval.index import Index

WANTED = {"format": checkpoint.FORMAT, "name": "08", "recording": "a"}
EMPTY = Index.empty(4, weights_hash="w")


class FakeFinder(CandidateFinder):
    """A finder without a network that counts frames."""

    def __init__(self):
        self.stored, self.frames = StoredScans(EMPTY), 0

    def __len__(self) -> int:
        return self.frames


def fake_frames(seed: int = 0, frames: int = 5) -> list[tuple[Seen | None, Compared]]:
    """Frames with their comparisons, drawn at random. The second frame has no scan."""
    draw, found = np.random.default_rng(seed), []
    for frame in range(frames):
        seen = Seen(draw.normal(size=4).astype(np.float32), draw.integers(0, 255, (6, 6), np.uint8), None)
        link = Link(*map(np.asarray, draw.normal(size=6))) if frame else None
        fits = Fits(np.array([1, 3]), Peak(*draw.normal(size=(5, 2)))) if frame == 4 else NO_FITS
        found.append((None if frame == 1 else seen, Compared(fits, link)))
    return found


def recalled(folder: Path, wanted: dict) -> list:
    """The frames that a checkpoint directory gives back."""
    finder, found = FakeFinder(), []

    def add(seen, compared):
        found.append((seen, compared))
        finder.frames += 1

    kept = checkpoint.Unfinished.opened(folder, wanted)
    kept.recall(finder, lambda frame: None, add, missing=True)
    return found


def keep(folder: Path, wanted: dict, *, seed: int = 0, stops: tuple[int, ...] = (5,)) -> Path:
    """Keep frames in a folder, with a file for the frames before each stop. Returns the first file."""
    kept = checkpoint.Unfinished.opened(folder, wanted)
    for frame, (seen, compared) in enumerate(fake_frames(seed, frames=stops[-1]), start=1):
        kept.keep(seen, compared, index=EMPTY)
        if frame in stops:
            kept.write(EMPTY)
    return folder / "000000.safetensors"
