"""The score of a training run: how well it tells the places of its own drives apart."""

from collections.abc import Callable
from collections.abc import Sequence as Many

import numpy as np

from sglpr_jax.data import Drive
from sglpr_jax.data.tuples import TuplePool
from sglpr_jax.models.sglpr import Params
from sglpr_jax.train.config import TrainConfig
from sglpr_jax.train.describe_places import describe_places

PLACES = 192
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

    def score(params: Params) -> dict[str, float]:
        described = describe_places(
            params, drives, pool, frames.reshape(-1), angles.reshape(-1) * config.rotate, config
        )
        anchors, positives = described.reshape(PLACES, 2, -1).transpose(1, 0, 2)
        nearest = (anchors @ positives.T).argmax(1)
        return {"score": float(same_place[np.arange(PLACES), nearest].mean())}

    return score
