"""Score of a training run on held-out places: retrieval among places that were never trained on."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float32, Int
from scipy.spatial.distance import cdist

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.sampling.tuples import TuplePool
from sglpr_jax.metrics import decision_curve
from sglpr_jax.models.params import Params
from sglpr_jax.training.batches import tuple_pool
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.describe_places import describe_places

_SEED = 2**31 - 1


def validation_score(
    recordings: Sequence[Recording], frames: Sequence[Int[np.ndarray, "_"]], config: TrainConfig
) -> Callable[[Params], dict[str, float]]:
    """Return a function that scores weights by retrieval among the held-out `frames` of each recording.

    Every frame is rotated at random and searches for its nearest descriptor among all others. `recall_neighbours`
    counts any frame within the positive distance as found. If there are revisits, `recall_revisits` and `f1max` exclude
    frames of the same visit, and "score" is their mean. Otherwise "score" is `recall_neighbours`.

    Raises ValueError if no two held-out frames are within the positive distance.
    """
    try:
        pool = tuple_pool(recordings, config, frames=frames)
    except ValueError as error:
        raise ValueError(f"the part held out by validation.share is too small: {error}") from error
    angles = np.random.default_rng(_SEED).uniform(0, 2 * np.pi, len(pool)) * config.rotate

    def score(params: Params) -> dict[str, float]:
        descriptors = describe_places(params, recordings, pool, np.arange(len(pool)), angles, config)
        recall, _ = retrieval(descriptors, pool, gap=0)
        if not len(pool.revisits.anchors):
            return {"score": recall, "recall_neighbours": recall}
        revisits, f1_max = retrieval(descriptors, pool, gap=config.sampling.revisit_gap)
        score = (revisits + f1_max) / 2
        return {"score": score, "recall_neighbours": recall, "recall_revisits": revisits, "f1max": f1_max}

    return score


def retrieval(descriptors: Float32[np.ndarray, "n d"], pool: TuplePool, *, gap: int) -> tuple[float, float]:
    """Return Recall@1 and top-1 F1max. Every frame searches other recordings and frames more than `gap` frames away.

    Recall@1 is the fraction found among the frames with a match. At least one frame must have a match. For F1max, the
    nearest frame is accepted up to a threshold on the descriptor distance. It is right within the positive distance of
    places and wrong beyond the negative one.
    """
    every = np.arange(len(pool))
    same_recording = pool.recording[:, None] == pool.recording[None]
    own_visit = same_recording & (np.abs(pool.frame[:, None] - pool.frame[None]) <= gap)
    apart = cdist(pool.positions[:, :2], pool.positions[:, :2])
    findable = same_recording & ~own_visit & (apart < pool.config.positive_m)
    distance = np.where(own_visit, np.inf, cdist(descriptors, descriptors))
    nearest = distance.argmin(1)
    found, searched = findable[every, nearest], findable.any(1)
    curve = decision_curve(
        -distance[every, nearest],
        true_if_accepted=found,
        false_if_accepted=pool.far_apart(every, nearest),
        missed_if_rejected=searched,
    )
    return float(found[searched].mean()), curve.f1_max
