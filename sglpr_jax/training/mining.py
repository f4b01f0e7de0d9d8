"""Hard negatives: places with similar descriptors, which are recomputed at regular steps."""

import dataclasses
import functools
from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int

from sglpr_jax.files import replacing
from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.numpy_files import read_arrays
from sglpr_jax.training.step import TrainState

FOLDER = "mining"

DescribeFn = Callable[[TrainState, Int[np.ndarray, "n"]], Float32[np.ndarray, "n d"]]
"""Describes places, given as frame numbers of the pool."""


@dataclasses.dataclass(frozen=True, eq=False)
class DescriptorCache:
    """Descriptors of some places. `places` are frame numbers of a `TuplePool` in ascending order."""

    places: Int[np.ndarray, "n"]
    descriptors: Float32[np.ndarray, "n d"]

    def nearest(self, anchor: int, candidates: Int[np.ndarray, "_"], size: int) -> Int[np.ndarray, "_"]:
        """Return at most `size` candidates with the descriptors nearest to the anchor's, nearest first.

        Candidates that are not in the cache are skipped. If the anchor is not in the cache, the result is empty.
        """
        candidates = candidates[np.isin(candidates, self.places, assume_unique=True)]
        if anchor not in self.places:
            return candidates[:0]
        rows, row = np.searchsorted(self.places, candidates), np.searchsorted(self.places, anchor)
        # |a - b|^2 - |a|^2 needs one matrix-vector product. Differences would copy the whole cache.
        square = self._squares - 2 * (self.descriptors @ self.descriptors[row])
        return candidates[np.argsort(square[rows], kind="stable")[:size]]

    @functools.cached_property
    def _squares(self) -> Float32[np.ndarray, "n"]:
        return np.square(self.descriptors).sum(1)

    def save(self, path: Path) -> None:
        """Write the file atomically."""
        with replacing(path) as temporary, temporary.open("wb") as stream:
            np.savez(stream, places=self.places, descriptors=self.descriptors)

    @classmethod
    def load(cls, path: Path) -> "DescriptorCache":
        """Read a file written by `save`. Raises FileNotFoundError, or ValueError if the file is damaged."""
        found = read_arrays(path, expected="descriptors of places")
        places, descriptors = found.get("places"), found.get("descriptors")
        if places is None or descriptors is None or places.shape != descriptors.shape[:1] or descriptors.ndim != 2:
            shapes = ", ".join(f"{name} {array.shape}" for name, array in found.items())
            raise ValueError(f"{path}: expected places (n,) and descriptors (n, d), found {shapes or 'no array'}")
        return cls(places, descriptors)


class Mining:
    """Descriptor cache of a run. A refresh at step r runs before that step and writes `folder`/r.npz.

    A run that is resumed between two refreshes reads that file, so its batches are those of an uninterrupted run.
    """

    def __init__(
        self,
        describe: DescribeFn,
        places: int,
        config: TupleConfig,
        folder: Path,
        *,
        seed: int,
        checkpoints: Callable[[], Collection[int]],
    ):
        """`places` is the size of the pool, `folder` has the caches, and `seed` draws the places that are described.
        `checkpoints` returns the steps of the complete checkpoints of the run."""
        self._describe, self._places, self._config, self._folder = describe, places, config, folder
        self._seed, self._checkpoints = seed, checkpoints
        self.cache: DescriptorCache | None = None

    def refresh(self, step: int, state: TrainState) -> None:
        """Load or compute the cache that `step` uses. `state` is the one before that step.

        Raises FileNotFoundError if the cache of an earlier step is needed but missing.
        """
        every = self._config.refresh_steps
        path = self._folder / f"{step - step % every}.npz"
        if path.is_file() or step % every:
            self.cache = DescriptorCache.load(path)
            return
        places = self._chosen(step)
        self.cache = DescriptorCache(places, self._describe(state, places))
        self.cache.save(path)
        self._drop_unneeded()

    def _chosen(self, step: int) -> Int[np.ndarray, "n"]:
        wanted = self._config.mined_places
        if not 0 < wanted < self._places:
            return np.arange(self._places)
        rng = np.random.default_rng([self._seed, step])
        return np.sort(rng.choice(self._places, wanted, replace=False))

    def _drop_unneeded(self) -> None:
        """Delete the caches that no kept checkpoint needs. A resumed run reads the cache of its next step."""
        every = self._config.refresh_steps
        asked = {step - step % every for step in self._checkpoints()}
        for path in self._folder.glob("*.npz"):
            if path.stem.isdecimal() and int(path.stem) not in asked and int(path.stem) < max(asked, default=0):
                path.unlink()
