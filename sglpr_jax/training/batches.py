"""Training batches: tuples of places from one or two datasets."""

import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.sampling.batch import Batch, read_batch
from sglpr_jax.data.sampling.mixing import mix
from sglpr_jax.data.sampling.tuples import TuplePool
from sglpr_jax.models.params import Params
from sglpr_jax.training.batch_queue import BatchSource
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.hosts import own_part
from sglpr_jax.training.mining import Mining


def tuple_pool(
    recordings: Sequence[Recording], config: TrainConfig, *, frames: Sequence[Int[np.ndarray, "_"]] | None = None
) -> TuplePool:
    """Collect the tuples of the recordings, or of their `frames`. Raises ValueError if there are no tuples."""
    return TuplePool([positions_of(recording) for recording in recordings], config.sampling, frames=frames)


def positions_of(recording: Recording) -> Float[np.ndarray, "n 3"]:
    """Return the positions of a recording, in metres. Raises ValueError if it has none."""
    if recording.positions is None:
        raise ValueError(f"sequence {recording.name} has no poses; training and testing need them")
    return recording.positions


class TupleBatches(BatchSource):
    """Batches of tuples from `pool`, read from `recordings`.

    With `also`, `config.also_tuples` tuples of each step come from these recordings of a second dataset. With `mining`,
    the negatives are places whose descriptors were similar at the last refresh.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        pool: TuplePool,
        config: TrainConfig,
        *,
        also: Sequence[Recording] = (),
        mining: Mining | None = None,
    ):
        self._recordings, self._pool, self._config, self._mining = recordings, pool, config, mining
        self._also, self._also_pool = also, tuple_pool(also, config) if also else None
        self._tuples = config.tuples - config.also_tuples
        self.refresh_steps = config.sampling.refresh_steps if mining else 0

    def batch(self, step: int) -> Batch:
        """Return this host's part of the batch of a step."""
        config, read = self._config, self._read_batch()
        main = read(self._recordings, self._pool, self._frames(step), part=own_part(self._tuples))
        if self._also_pool is None:
            return main
        second = read(self._also, self._also_pool, self._also_frames(self._also_pool, step))
        return mix(main, second, triplets=config.also_triplets, share_negatives=config.share_negatives)

    def refresh(self, step: int, params: Params) -> None:
        """Recompute the descriptors that mining compares, if negatives are mined."""
        if self._mining is not None:
            self._mining.refresh(step, params)

    def places(self, step: int) -> str:
        """Describe the places in the batch of a step: recordings and scans of both datasets."""
        named = _named(self._recordings, self._pool, self._frames(step))
        if self._also_pool is not None:
            named += _named(self._also, self._also_pool, self._also_frames(self._also_pool, step))
        return "; ".join(named)

    def _frames(self, step: int) -> Int[np.ndarray, "t k"]:
        cache = self._mining.cache if self._mining else None
        return self._pool.draw(seed=self._config.seed, step=step, tuples=self._tuples, cache=cache)

    def _also_frames(self, pool: TuplePool, step: int) -> Int[np.ndarray, "t k"]:
        draw = pool.draw if self._config.also_triplets else pool.draw_places
        return draw(seed=self._config.seed, step=step, tuples=self._config.also_tuples)

    def _read_batch(self):
        config = self._config
        return functools.partial(
            read_batch,
            max_points=config.max_points,
            share_negatives=config.share_negatives,
            categories=config.model.categories,
            image=config.model.image,
        )


def _named(recordings: Sequence[Recording], pool: TuplePool, frames: Int[np.ndarray, "t k"]) -> list[str]:
    """Return the recordings and scan ids of the given frames, as text for messages."""
    places, named = np.unique(frames), []
    for number, recording in enumerate(recordings):
        ids = [recording.ids[pool.frame[f]] for f in places[pool.recording[places] == number]]
        named += [f"recording {recording.name} frames {' '.join(ids)}"] if ids else []
    return named
