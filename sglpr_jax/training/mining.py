"""Hard negatives: places with similar descriptors, which are recomputed at regular steps."""

from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int

from sglpr_jax.data.sampling.descriptor_cache import DescriptorCache
from sglpr_jax.models.params import Params
from sglpr_jax.training.config import TrainConfig

FOLDER = "mining"

DescribeFn = Callable[[Params, Int[np.ndarray, "n"]], Float32[np.ndarray, "n d"]]
"""Describes places, given as frame numbers of the pool."""


class Mining:
    """Descriptor cache of a run, with the files on disk that a resumed run may need.

    A refresh at step r runs before that step and writes `folder`/r.npz. Steps r to r + refresh_steps - 1 use it. A run
    resumed in between reads the same file, so its batches are those of an uninterrupted run.
    """

    def __init__(
        self,
        describe: DescribeFn,
        places: int,
        config: TrainConfig,
        folder: Path,
        *,
        checkpoints: Callable[[], Collection[int]],
    ):
        """Create a miner without a cache.

        Arguments:
          describe: Describes places of the pool.
          places: Number of places of the pool.
          config: Settings of the run.
          folder: Folder of the caches.
          checkpoints: Returns the steps of the complete checkpoints of the run.
        """
        self._describe, self._places, self._config, self._folder = describe, places, config, folder
        self._checkpoints = checkpoints
        self.cache: DescriptorCache | None = None

    def refresh(self, step: int, params: Params) -> None:
        """Load or compute the cache that `step` uses. `params` are the weights before that step.

        Raises FileNotFoundError if the cache of an earlier step is needed but missing.
        """
        every = self._config.sampling.refresh_steps
        path = self._folder / f"{step - step % every}.npz"
        if path.is_file() or step % every:
            self.cache = DescriptorCache.load(path)
            return
        self.cache = self._described(step, params)
        self.cache.save(path)
        self._drop_unneeded()

    def _described(self, step: int, params: Params) -> DescriptorCache:
        wanted = self._config.sampling.mined_places
        places = np.arange(self._places)
        if 0 < wanted < self._places:
            rng = np.random.default_rng([self._config.seed, step])
            places = np.sort(rng.choice(self._places, wanted, replace=False))
        return DescriptorCache(places, self._describe(params, places))

    def _drop_unneeded(self) -> None:
        """Delete the caches that no kept checkpoint needs. An old best checkpoint may still need one.

        A run resumed from a checkpoint reads the cache of its next step and recomputes the later ones. A newer
        checkpoint may still be in the process of being written, so caches from the newest needed one on are kept.
        """
        every = self._config.sampling.refresh_steps
        asked = {step - step % every for step in self._checkpoints()}
        for path in self._folder.glob("*.npz"):
            if path.stem.isdecimal() and int(path.stem) not in asked and int(path.stem) < max(asked, default=0):
                path.unlink()
