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
from sglpr_jax.training.batches import Batch, mix, read_batch
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.devices import host_slice
from sglpr_jax.training.mining import DescriptorCache, refresh_cache
from sglpr_jax.training.step import TrainState
from sglpr_jax.training.tuples import TuplePool, tuple_pool

T = TypeVar("T")
DescribeFn = Callable[[TrainState, Int[np.ndarray, "n"]], Float32[np.ndarray, "n d"]]
"""`(state, places) -> descriptors`. The places are numbers of a `TuplePool`; the state has the weights."""


class TupleBatches:
    """Batches of the tuples (anchor, positives, negatives) that a pool draws.

    A batch depends only on the seed, the step and the descriptors that select hard negatives (`refresh`).
    """

    refresh_steps: int = 0
    """Number of steps between calls of `refresh`, or 0. A call precedes the batches from its step on."""

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
        """Define batches with `tuples` tuples of the pool, which has places of the `recordings`.

        Arguments:
          read: Reads the scans of place numbers (tuple, place of the tuple) and returns their batch.
          describe: Computes the descriptors that select hard negatives, if `pool.config.mining` is "hardest".
          run: Folder of the run, which stores these descriptors.
          random_places: Draw any places instead of tuples.
        """
        self._recordings, self._pool, self._read, self._seed = recordings, pool, read, seed
        self._describe, self._run = describe, run
        self._descriptor_cache: DescriptorCache | None = None
        draw = pool.draw_places if random_places else pool.draw
        self._draw = functools.partial(draw, seed=seed, tuples=tuples)
        if describe is not None and pool.config.mining == "hardest":
            self.refresh_steps = pool.config.refresh_steps

    def batch(self, step: int) -> Any:
        """Return this host's part of the batch of a step."""
        return self._read(self._draw_step(step))

    def refresh(self, step: int, state: TrainState) -> None:
        """Recompute the descriptors that select hard negatives, with the weights in `state`, which precedes `step`."""
        assert self._describe is not None and self._run is not None
        describe = functools.partial(self._describe, state)
        pool = self._pool
        self._descriptor_cache = refresh_cache(step, describe, len(pool), pool.config, self._run, seed=self._seed)

    def scan_names(self, step: int) -> str:
        """Return the recordings and scan ids of the batch of a step, as text for an error message."""
        places, names = np.unique(self._draw_step(step)), []
        for number, recording in enumerate(self._recordings):
            rows = self._pool.frame_of[places[self._pool.recording_of[places] == number]]
            if len(rows):
                names.append(f"recording {recording.name} frames {' '.join(recording.ids[row] for row in rows)}")
        return "; ".join(names)

    def _draw_step(self, step: int) -> Int[np.ndarray, "t k"]:
        """Draw the place numbers of a step (tuple, place of the tuple)."""
        if self._descriptor_cache is None:  # `TuplePool.draw_places` has no argument `cache`
            return self._draw(step=step)
        return self._draw(step=step, cache=self._descriptor_cache)


class MixedBatches(TupleBatches):
    """Batches with tuples of two datasets, which `mix` joins. Only the first dataset has mined hard negatives."""

    def __init__(self, first: TupleBatches, second: TupleBatches, mix: Callable[[Batch, Batch], Batch]):
        self._first, self._second, self._mix = first, second, mix
        self.refresh_steps, self.refresh = first.refresh_steps, first.refresh

    def batch(self, step: int) -> Batch:
        """Return the batch of a step."""
        return self._mix(self._first.batch(step), self._second.batch(step))

    def scan_names(self, step: int) -> str:
        """Return the recordings and scan ids of both datasets in the batch of a step, as text."""
        return "; ".join(filter(None, (self._first.scan_names(step), self._second.scan_names(step))))


def training_batches(
    recordings: Sequence[Recording],
    pool: TuplePool,
    config: TrainConfig,
    *,
    also: Sequence[Recording] = (),
    describe: DescribeFn | None = None,
    run: Path | None = None,
) -> TupleBatches:
    """Return the batches of a configuration, with tuples of `recordings` from the pool.

    `also` are recordings of a second dataset, which provide `config.also_tuples` of the tuples of each step. If the
    configuration mines hard negatives, `describe` computes their descriptors, which the folder `run` stores.
    """
    read = functools.partial(
        read_batch,
        max_points=config.max_points,
        share_negatives=config.share_negatives,
        categories=config.model.categories,
        image=config.model.image,
    )
    tuples = config.tuples - config.also_tuples
    read_first = functools.partial(read, recordings, pool, part=host_slice(tuples))
    first = TupleBatches(recordings, pool, read_first, seed=config.seed, tuples=tuples, describe=describe, run=run)
    if not also:
        return first
    second_pool = tuple_pool(also, config.sampling)
    second = TupleBatches(
        also,
        second_pool,
        functools.partial(read, also, second_pool),
        seed=config.seed,
        tuples=config.also_tuples,
        random_places=not config.also_triplets,
    )
    join = functools.partial(mix, triplets=config.also_triplets, share_negatives=config.share_negatives)
    return MixedBatches(first, second, join)


def batches_in_order(
    source: TupleBatches,
    state: Callable[[], TrainState],
    *,
    start: int,
    stop: int,
    to_devices: Callable[[Any], Any] = lambda batch: batch,
) -> Generator[Any, None, None]:
    """Yield the batches of the steps from `start` to `stop` - 1.

    Every `source.refresh_steps` steps, and at `start`, `source.refresh` is called with the state that `state` returns.
    Batches are read ahead up to the next refresh. `to_devices` moves a batch; it runs in the reading thread.
    """
    while start < stop:
        next_refresh = stop
        if source.refresh_steps:
            source.refresh(start, state())
            next_refresh = min(start - start % source.refresh_steps + source.refresh_steps, stop)
        yield from read_ahead(lambda step: to_devices(source.batch(step)), start=start, stop=next_refresh)
        start = next_refresh


def read_ahead(make: Callable[[int], T], *, start: int, stop: int, depth: int = 2) -> Iterator[T]:
    """Yield make(start), ..., make(stop - 1) in order. A thread computes up to `depth` values ahead.

    An exception of `make` is raised when its value is due. Closing the iterator stops the thread.
    """
    with concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as thread:
        pending = collections.deque(thread.submit(make, step) for step in range(start, min(start + depth, stop)))
        try:
            for step in range(start, stop):
                value = pending.popleft().result()
                if step + depth < stop:
                    pending.append(thread.submit(make, step + depth))
                yield value
        finally:
            thread.shutdown(cancel_futures=True)
