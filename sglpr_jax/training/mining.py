"""Descriptors that select hard negatives: distant places with similar descriptors. Recomputed at regular steps."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int

from sglpr_jax.files import replacing
from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.numpy_files import read_arrays
from sglpr_jax.training.run_folder import CHECKPOINTS, checkpoint_steps

MINING = "mining"
"""Folder of the descriptor caches, in the folder of a run."""


@dataclasses.dataclass(frozen=True, eq=False)
class DescriptorCache:
    """Descriptors of some places of a `TuplePool`. `places` are their numbers in ascending order."""

    places: Int[np.ndarray, "n"]
    descriptors: Float32[np.ndarray, "n d"]

    def nearest(self, anchor: int, candidates: Int[np.ndarray, "_"], size: int) -> Int[np.ndarray, "_"]:
        """Return at most `size` candidates with the descriptors nearest to the anchor's, nearest first.

        Anchor and candidates are place numbers of the pool. Candidates that are not in the cache are skipped. If the
        anchor is not in the cache, the result is empty.
        """
        candidates = candidates[np.isin(candidates, self.places, assume_unique=True)]
        if anchor not in self.places:
            return candidates[:0]
        anchor_row, candidate_rows = np.searchsorted(self.places, anchor), np.searchsorted(self.places, candidates)
        # |d - a|^2 - |a|^2 = |d|^2 - 2 d a needs one matrix-vector product. Differences would copy the whole cache.
        relative_distances = self._squared_norms - 2 * (self.descriptors @ self.descriptors[anchor_row])
        return candidates[np.argsort(relative_distances[candidate_rows], kind="stable")[:size]]

    @functools.cached_property
    def _squared_norms(self) -> Float32[np.ndarray, "n"]:
        return np.square(self.descriptors).sum(1)

    def save(self, path: Path) -> None:
        """Write the file atomically."""
        with replacing(path) as temporary, temporary.open("wb") as stream:
            np.savez(stream, places=self.places, descriptors=self.descriptors)

    @classmethod
    def load(cls, path: Path) -> "DescriptorCache":
        """Read a file written by `save`. Raises FileNotFoundError, or ValueError if the file is damaged."""
        arrays = read_arrays(path, expected="descriptors of places")
        places, descriptors = arrays.get("places"), arrays.get("descriptors")
        if places is None or descriptors is None or places.shape != descriptors.shape[:1] or descriptors.ndim != 2:
            shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
            raise ValueError(f"{path}: expected places (n,) and descriptors (n, d), found {shapes or 'no array'}")
        return cls(places, descriptors)


def refresh_cache(
    step: int,
    describe: Callable[[Int[np.ndarray, "n"]], Float32[np.ndarray, "n d"]],
    pool_size: int,
    config: TupleConfig,
    run: Path,
    *,
    seed: int,
) -> DescriptorCache:
    """Load or compute the descriptors of the last refresh, at the last multiple of `config.refresh_steps`.

    The folder of the run stores them. A run that is resumed between two refreshes loads them, so its batches are those
    of an uninterrupted run. Files that no checkpoint needs are deleted.

    `describe` describes places, given as numbers of the pool, with the weights before `step`, the next step of the run.
    Of the `pool_size` places, `config.mined_places` random ones are described. `DescriptorCache.load` raises
    FileNotFoundError if the last refresh was at an earlier step and its file is missing.
    """
    folder, last_refresh = run / MINING, step - step % config.refresh_steps
    path = folder / f"{last_refresh}.npz"
    if path.is_file() or step > last_refresh:
        return DescriptorCache.load(path)
    places = np.arange(pool_size)
    if 0 < config.mined_places < pool_size:
        places = np.sort(np.random.default_rng([seed, step]).choice(pool_size, config.mined_places, replace=False))
    cache = DescriptorCache(places, describe(places))
    cache.save(path)
    needed = {saved - saved % config.refresh_steps for saved in checkpoint_steps(run / CHECKPOINTS)}
    for file in folder.glob("*.npz"):
        if file.stem.isdecimal() and int(file.stem) not in needed and int(file.stem) < max(needed, default=0):
            file.unlink()
    return cache
