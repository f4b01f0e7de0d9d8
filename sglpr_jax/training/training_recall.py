"""The score of a training run: how well it tells the places of its own recordings apart."""

from collections.abc import Callable, Sequence

import numpy as np

from sglpr_jax.data import Recording
from sglpr_jax.data.sampling.tuples import TuplePool
from sglpr_jax.models.params import Params
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.describe_places import describe_places

PLACES = 192
_SEED = 2**31 - 1  # no training run's, so that these are not the tuples of a step


def training_recall(
    recordings: Sequence[Recording], pool: TuplePool, config: TrainConfig
) -> Callable[[Params], dict[str, float]]:
    """Return a function that scores weights by Recall@1 among fixed places of the training recordings.

    The places come in pairs of an anchor and a positive, each rotated at random. An anchor is found where the nearest
    of all the positives' descriptors is of a place less than the positive distance away. The recording that is tested
    has no part in it, so the score may choose checkpoints; but these places are trained on, so it says little about
    new ones.
    """
    frames = pool.draw(seed=_SEED, step=0, tuples=PLACES)[:, :2]
    offset = pool.positions[frames[:, :1], :2] - pool.positions[None, frames[:, 1], :2]
    same_recording = pool.recording[frames[:, :1]] == pool.recording[None, frames[:, 1]]
    same_place = same_recording & (np.linalg.norm(offset, axis=-1) < pool.config.positive_m)
    angles = np.random.default_rng(_SEED).uniform(0, 2 * np.pi, frames.shape).astype(np.float32)

    def score(params: Params) -> dict[str, float]:
        described = describe_places(
            params, recordings, pool, frames.reshape(-1), angles.reshape(-1) * config.rotate, config
        )
        anchors, positives = described.reshape(PLACES, 2, -1).transpose(1, 0, 2)
        nearest = (anchors @ positives.T).argmax(1)
        return {"score": float(same_place[np.arange(PLACES), nearest].mean())}

    return score
