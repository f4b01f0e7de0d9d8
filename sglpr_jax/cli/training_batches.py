"""The batches of a training run, from one source or two."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Int

from sglpr_jax.data import Drive
from sglpr_jax.data.batch import Batch, read_batch
from sglpr_jax.data.mixing import mix
from sglpr_jax.data.tuples import TuplePool
from sglpr_jax.train.config import TrainConfig
from sglpr_jax.train.hosts import own_part
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
    """This host's part of the batch of each step: a function of the step and, with `mining`, of its present cache.

    The drives of `also` have `config.also_tuples` of the tuples.
    """
    also_pool = tuple_pool(also, config) if also else None
    options = {
        "max_points": config.max_points,
        "share_negatives": config.share_negatives,
        "categories": config.model.categories,
        "image": config.model.image,
    }

    tuples = main_tuples(config)

    def make_batch(step: int) -> Batch:
        frames = pool.draw(seed=config.seed, step=step, tuples=tuples, cache=mining.cache if mining else None)
        main = read_batch(drives, pool, frames, part=own_part(tuples), **options)
        if also_pool is None:
            return main
        draw = also_pool.draw if config.also_triplets else also_pool.draw_places
        second = read_batch(also, also_pool, draw(seed=config.seed, step=step, tuples=config.also_tuples), **options)
        return mix(main, second, triplets=config.also_triplets, share_negatives=config.share_negatives)

    return make_batch


def named_places(
    drives: Sequence[Drive], pool: TuplePool, config: TrainConfig, step: int, *, mining: Mining | None
) -> str:
    """The frames of a step's batch, for an error: the drives they are of and their names there."""
    cache = mining.cache if mining else None
    frames = np.unique(pool.draw(seed=config.seed, step=step, tuples=main_tuples(config), cache=cache))
    of_drive = {drive.name: frames[pool.drive[frames] == number] for number, drive in enumerate(drives)}
    named = {drive.name: " ".join(drive.ids[pool.frame[f]] for f in of_drive[drive.name]) for drive in drives}
    return "; ".join(f"drive {name} frames {ids}" for name, ids in named.items() if ids)


def main_tuples(config: TrainConfig) -> int:
    """The tuples of a step that the main dataset has."""
    return config.tuples - config.also_tuples


def positions_of(drive) -> np.ndarray:
    """The positions of a drive that has them."""
    return drive.positions
