"""Score of a training run without held-out places: Recall@1 among training places."""

from collections.abc import Callable, Sequence

import numpy as np

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.sampling.tuples import TuplePool
from sglpr_jax.models.params import Params
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.describe_places import describe_places

PLACES = 192
_SEED = 2**31 - 1  # not the seed of a training run, so that these are not the tuples of a step


def training_recall(
    recordings: Sequence[Recording], pool: TuplePool, config: TrainConfig
) -> Callable[[Params], dict[str, float]]:
    """Return a function that scores weights by Recall@1 among fixed places of the training recordings.

    The places are pairs of an anchor and a positive, each rotated at random. A pair counts as found if the nearest of
    all positive descriptors belongs to a place within the positive distance of the anchor. The test recording is not
    used, so the score may select checkpoints. The places are training places, so the score says little about new
    places.
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
