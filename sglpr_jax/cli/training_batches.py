"""The batches of a training run, from one source or two."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Int

from sglpr_jax.data import Drive
from sglpr_jax.data.batch import Batch, read_batch
from sglpr_jax.data.mixing import mix
from sglpr_jax.data.tuples import TuplePool
from sglpr_jax.train.config import TrainConfig
from sglpr_jax.train.mining import Mining


def tuple_pool(
    drives: Sequence[Drive], config: TrainConfig, *, frames: Sequence[Int[np.ndarray, "_"]] | None = None
) -> TuplePool:
    """The tuples that drives hold, or their `frames`."""
    return TuplePool([positions_of(drive) for drive in drives], config.sampling, frames=frames)


def batches(
    drives: Sequence[Drive],
    pool: TuplePool,
    config: TrainConfig,
    *,
    also: Sequence[Drive] = (),
    mining: Mining | None = None,
) -> Callable[[int], Batch]:
    """The batch of each step: a function of the step and, with `mining`, of its present cache.

    The drives of `also` have `config.also_tuples` of the tuples.
    """
    also_pool = tuple_pool(also, config) if also else None
    options = {
        "max_points": config.max_points,
        "share_negatives": config.share_negatives,
        "categories": config.model.categories,
    }

    def make_batch(step: int) -> Batch:
        tuples = config.tuples - (config.also_tuples if also else 0)
        cache = mining.cache if mining else None
        main = read_batch(drives, pool, pool.draw(seed=config.seed, step=step, tuples=tuples, cache=cache), **options)
        if also_pool is None:
            return main
        draw = also_pool.draw if config.also_triplets else also_pool.draw_places
        second = read_batch(also, also_pool, draw(seed=config.seed, step=step, tuples=config.also_tuples), **options)
        return mix(main, second, triplets=config.also_triplets, share_negatives=config.share_negatives)

    return make_batch


def positions_of(drive) -> np.ndarray:
    """The positions of a drive that has them."""
    return drive.positions
