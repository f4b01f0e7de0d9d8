"""Batches of a run in the order of its steps, read by a thread while the device works."""

import collections
import concurrent.futures
import functools
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float32, Int

from sglpr_jax.data.recording import Recording
from sglpr_jax.training.batches import Batch, mix, read_batch, tuple_pool
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.devices import own_part
from sglpr_jax.training.mining import DescriptorCache, refresh_cache
from sglpr_jax.training.step import TrainState
from sglpr_jax.training.tuples import TuplePool

T = TypeVar("T")
DescribeFn = Callable[[TrainState, Int[np.ndarray, "n"]], Float32[np.ndarray, "n d"]]
"""Describes places, given as frame numbers of a pool, with the weights of a state."""


class TupleBatches:
    """Batches of the tuples that a pool draws. A batch depends only on the seed, the step and the mined descriptors."""

    refresh_steps: int = 0
    """Number of steps between calls of `refresh`, or 0 for no refresh. A batch at or after a refresh step may only be
    requested after that call."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        pool: TuplePool,
        read: Callable[[Int[np.ndarray, "t k"]], Any],
        *,
        seed: int,
        tuples: int,
        describe: DescribeFn | None = None,
        run: Path | None = None,
        random_places: bool = False,
    ):
        """Define the batches.

        Arguments:
          recordings: Recordings of the pool.
          pool: Pool of the tuples.
          read: Reads the batch of frames, one row per tuple.
          seed: Seed of the tuples.
          tuples: Number of tuples per step.
          describe: Computes the descriptors that select hard negatives, if `pool.config` mines them.
          run: Folder of the run, which stores these descriptors.
          random_places: Draw any places instead of tuples.
        """
        self._recordings, self._pool, self._read, self._seed = recordings, pool, read, seed
        self._describe, self._run, self._cache = describe, run, None
        draw = pool.draw_places if random_places else pool.draw
        self._draw = functools.partial(draw, seed=seed, tuples=tuples)
        if describe is not None and pool.config.mining == "hardest":
            self.refresh_steps = pool.config.refresh_steps

    def batch(self, step: int) -> Any:
        """Return this host's part of the batch of a step."""
        return self._read(self._frames(step))

    def refresh(self, step: int, state: TrainState) -> None:
        """Recompute the descriptors that select hard negatives, with the state before `step`."""
        assert self._describe is not None and self._run is not None
        describe = functools.partial(self._describe, state)
        self._cache = refresh_cache(step, describe, len(self._pool), self._pool.config, self._run, seed=self._seed)

    def places(self, step: int) -> str:
        """Name the recordings and scans in the batch of a step."""
        frames, names = np.unique(self._frames(step)), []
        for number, recording in enumerate(self._recordings):
            ids = [recording.ids[self._pool.frame[frame]] for frame in frames[self._pool.recording[frames] == number]]
            names += [f"recording {recording.name} frames {' '.join(ids)}"] if ids else []
        return "; ".join(names)

    def _frames(self, step: int) -> Int[np.ndarray, "t k"]:
        mined: dict[str, DescriptorCache] = {} if self._cache is None else {"cache": self._cache}
        return self._draw(step=step, **mined)


class MixedBatches(TupleBatches):
    """Batches with tuples of two datasets, which `mix` joins."""

    def __init__(self, main: TupleBatches, also: TupleBatches, mix: Callable[[Batch, Batch], Batch]):
        self._main, self._also, self._mix = main, also, mix
        self.refresh_steps, self.refresh = main.refresh_steps, main.refresh

    def batch(self, step: int) -> Batch:
        """Return the batch of a step."""
        return self._mix(self._main.batch(step), self._also.batch(step))

    def places(self, step: int) -> str:
        """Name the recordings and scans of both datasets in the batch of a step."""
        return "; ".join(filter(None, (self._main.places(step), self._also.places(step))))


def batches_of(
    recordings: Sequence[Recording],
    pool: TuplePool,
    config: TrainConfig,
    *,
    also: Sequence[Recording] = (),
    describe: DescribeFn | None = None,
    run: Path | None = None,
) -> TupleBatches:
    """Return the batches of a configuration, with `config.also_tuples` tuples of each step from `also`."""
    share = config.share_negatives
    read = functools.partial(
        read_batch,
        max_points=config.max_points,
        share_negatives=share,
        categories=config.model.categories,
        image=config.model.image,
    )
    tuples = config.tuples - config.also_tuples
    main_read = functools.partial(read, recordings, pool, part=own_part(tuples))
    main = TupleBatches(recordings, pool, main_read, seed=config.seed, tuples=tuples, describe=describe, run=run)
    if not also:
        return main
    other = tuple_pool(also, config)
    second = TupleBatches(
        also,
        other,
        functools.partial(read, also, other),
        seed=config.seed,
        tuples=config.also_tuples,
        random_places=not config.also_triplets,
    )
    return MixedBatches(main, second, functools.partial(mix, triplets=config.also_triplets, share_negatives=share))


def batches_in_order(
    source: TupleBatches,
    state: Callable[[], TrainState],
    *,
    start: int,
    stop: int,
    place: Callable[[Any], Any] = lambda batch: batch,
) -> Generator[Any, None, None]:
    """Yield the batches of the steps from `start` to `stop` - 1, and refresh the source when it is due.

    Batches are read ahead up to the next refresh. `state` returns the state before the next step. `place` moves a batch
    to the devices; it runs in the reading thread.
    """
    every = source.refresh_steps
    while start < stop:
        end = min(start - start % every + every, stop) if every else stop
        if every:
            source.refresh(start, state())
        yield from read_ahead(lambda step: place(source.batch(step)), start=start, stop=end)
        start = end


def read_ahead(make: Callable[[int], T], *, start: int, stop: int, depth: int = 2) -> Iterator[T]:
    """Yield make(start), ..., make(stop - 1) in order. A thread computes up to `depth` values ahead.

    An exception of `make` is raised when its value is due. Closing the iterator stops the thread.
    """
    with concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as pool:
        ahead = collections.deque(pool.submit(make, step) for step in range(start, min(start + depth, stop)))
        try:
            for step in range(start, stop):
                value = ahead.popleft().result()
                if step + depth < stop:
                    ahead.append(pool.submit(make, step + depth))
                yield value
        finally:
            pool.shutdown(cancel_futures=True)
