"""Descriptors of places from an earlier training step, for selecting hard negatives."""

import dataclasses
import functools
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int

from sglpr_jax.files import replacing
from sglpr_jax.numpy_files import read_arrays


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
