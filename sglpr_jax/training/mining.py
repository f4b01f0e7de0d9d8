"""Hard negatives: which places look alike to the network as it is now, found out anew every so many steps."""

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
    """The newest descriptor cache of a run, and those on disk that a resumed run may need again.

    A refresh at step r, before it is made, writes `folder`/r.npz; steps r to r + refresh_steps - 1 use it. A run that
    goes on from a checkpoint in between reads the same numbers, so that its batches are those of a run never stopped.
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
        """`places`: how many the pool has. `checkpoints`: the steps of the run's checkpoints that are whole."""
        self._describe, self._places, self._config, self._folder = describe, places, config, folder
        self._checkpoints = checkpoints
        self.cache: DescriptorCache | None = None

    def refresh(self, step: int, params: Params) -> None:
        """Make the cache that `step` uses the current one; `params` are the weights before that step.

        Raises FileNotFoundError where the descriptors of an earlier step are needed and gone.
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
        """Remove caches that no checkpoint kept asks for, be it the best one and old.

        A run that goes on from a checkpoint reads the cache of its next step and makes those after it anew. A newer
        checkpoint than those there may be on its way to the disk: all that it can ask for stays.
        """
        every = self._config.sampling.refresh_steps
        asked = {step - step % every for step in self._checkpoints()}
        for path in self._folder.glob("*.npz"):
            if path.stem.isdecimal() and int(path.stem) not in asked and int(path.stem) < max(asked, default=0):
                path.unlink()
