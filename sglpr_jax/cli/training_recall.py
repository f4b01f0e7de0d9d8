"""The score of a training run: how well it tells the places of its own drives apart."""

from collections.abc import Callable
from collections.abc import Sequence as Many

import jax
import jax.numpy as jnp
import numpy as np

from sglpr_jax.data import Drive
from sglpr_jax.data.batch import read_batch, views
from sglpr_jax.data.tuples import TuplePool
from sglpr_jax.models.sglpr import Params, describe
from sglpr_jax.train.config import TrainConfig

PLACES = 192
CHUNK = 16
_SEED = 2**31 - 1  # no training run's, so that these are not the tuples of a step


def training_recall(drives: Many[Drive], pool: TuplePool, config: TrainConfig) -> Callable[[Params], dict[str, float]]:
    """A function of weights: Recall@1 among fixed places of the training drives, each view turned by a random angle.

    Every place is an anchor and a positive; an anchor's nearest descriptor among all the positives should be one less
    than the positive distance away. The drive that is tested has no part in it, so it may choose checkpoints; but
    these places are trained on, so it says little about new ones.
    """
    frames = pool.draw(seed=_SEED, step=0, tuples=PLACES)[:, :2]
    offset = pool.positions[frames[:, :1], :2] - pool.positions[None, frames[:, 1], :2]
    same_drive = pool.drive[frames[:, :1]] == pool.drive[None, frames[:, 1]]
    same_place = same_drive & (np.linalg.norm(offset, axis=-1) < pool.config.positive_m)
    angles = np.random.default_rng(_SEED).uniform(0, 2 * np.pi, frames.shape).astype(np.float32)

    @jax.jit
    def describe_chunk(params: Params, batch, angles):
        return describe(params, *views(batch, angles, params.config.grid))

    def score(params: Params) -> dict[str, float]:
        described = []
        for rows in np.split(np.arange(PLACES), PLACES // (CHUNK // 2)):
            batch = read_batch(
                drives,
                pool,
                frames[rows],
                max_points=config.max_points,
                share_negatives=True,
                categories=config.model.categories_read,
            )
            turned = jnp.asarray(angles[rows].reshape(-1)) * config.rotate
            described.append(np.asarray(describe_chunk(params, batch, turned)))
        anchors, positives = np.concatenate(described).reshape(PLACES, 2, -1).transpose(1, 0, 2)
        nearest = (anchors @ positives.T).argmax(1)
        return {"score": float(same_place[np.arange(PLACES), nearest].mean())}

    return score
