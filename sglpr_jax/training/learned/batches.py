"""Batches of a training of a learned method, with hard negatives if its recipe mines them."""

import contextlib
import functools
import math
from collections.abc import Callable, Generator
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int, Shaped

from sglpr_jax.data.sampling.descriptor_cache import DescriptorCache
from sglpr_jax.data.sampling.read_ahead import read_ahead
from sglpr_jax.data.sampling.tuples import TuplePool
from sglpr_jax.methods.learned.describe import describe_inputs
from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.training.learned.inputs import Prepared
from sglpr_jax.training.learned.step import Batch, State, distances_from_anchors

FOLDER = "mining"
ENDLESS = 2**62
DESCRIBED = 256
"""Number of places whose inputs are in memory at a time."""


class Batches:
    """Batches of the steps. They depend only on the seed, the step and the mined descriptors, if there are any."""

    def __init__(self, method: LearnedMethod, data: Prepared, *, seed: int, out: Path):
        """Find the tuples of the recordings.

        Arguments:
          method: Method with the settings of the tuples.
          data: Recordings with poses, and their inputs.
          seed: Seed of the tuples.
          out: Folder of the run, for the mined descriptors.

        Raises ValueError if no two frames are within the positive distance.
        """
        positions = [one.positions for one in data.recordings if one.positions is not None]
        self._pool = TuplePool(positions, method.recipe.sampling)
        self._method, self._data, self._seed = method, data, seed
        self._every = method.recipe.sampling.refresh_steps if method.recipe.sampling.mining == "hardest" else 0
        self._folder = out / FOLDER

    def batch(self, step: int, cache: DescriptorCache | None = None) -> Batch:
        """Draw the tuples of a step and read their inputs."""
        frames = self._pool.draw(seed=self._seed, step=step, tuples=self._method.recipe.tuples, cache=cache)
        return Batch(self._data.of(self._pool, frames.reshape(-1)), distances_from_anchors(self._pool, frames))

    def from_step(self, step: int, state: Callable[[], State]) -> Generator[Batch, None, None]:
        """Yield the batches from a step on, read ahead up to the next refresh of the mined descriptors."""
        while True:
            cache = self._mined(step, state) if self._every else None
            stop = step - step % self._every + self._every if self._every else ENDLESS
            make = functools.partial(self.batch, cache=cache)
            with contextlib.closing(read_ahead(make, start=step, stop=stop)) as ahead:
                yield from ahead
            step = stop

    def random_inputs(self, n: int) -> Shaped[np.ndarray, "n ..."]:
        """Return the inputs of up to n random places."""
        places = np.random.default_rng(self._seed).permutation(len(self._pool))[:n]
        return self._data.of(self._pool, places)

    def drop_before(self, step: int) -> None:
        """Delete the mined descriptors that a run resumed at `step` does not need."""
        for path in self._folder.glob("*.npz"):
            if int(path.stem) < step - step % self._every:
                path.unlink()

    def _mined(self, step: int, state: Callable[[], State]) -> DescriptorCache:
        """Load or compute the descriptors that a step draws negatives from."""
        path = self._folder / f"{step - step % self._every}.npz"
        if path.is_file() or step % self._every:
            return DescriptorCache.load(path)
        places, wanted = np.arange(len(self._pool)), self._method.recipe.sampling.mined_places
        if 0 < wanted < len(places):
            rng = np.random.default_rng([self._seed, step])
            places = np.sort(rng.choice(places, wanted, replace=False))
        found = DescriptorCache(places, self._described(places, state()))
        found.save(path)
        return found

    def _described(self, places: Int[np.ndarray, " n"], state: State) -> Float32[np.ndarray, "n d"]:
        blocks = np.array_split(places, math.ceil(len(places) / DESCRIBED))
        inputs = (self._data.of(self._pool, block) for block in blocks)
        return np.concatenate([describe_inputs(self._method, state.variables, one) for one in inputs])
