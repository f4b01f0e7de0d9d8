"""Scores of weights during a training: on training places, on held-out places, and on held-out recordings."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int
from scipy.spatial.distance import cdist

from sglpr_jax.data.recording import Recording
from sglpr_jax.methods.method import DistanceFn
from sglpr_jax.metrics import decision_curve
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import describe
from sglpr_jax.revisits import database_end, revisits
from sglpr_jax.training.batches import Batch, positions_of, read_batch, tuple_pool, views
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.tuples import TuplePool

CHUNK = 16
"""Number of places that are described at a time."""
PLACES = 192
"""Number of pairs of training places that are scored."""
RECALL = "recall_at_1"
"""Name of the score on held-out recordings."""
FOUND_M = 5.0
"""Maximum distance of a right answer in a held-out recording, in metres."""
QUERIES = 256
"""Number of queries that are compared at a time."""
_SEED = 2**31 - 1  # not the seed of a training run, so that these are not the tuples of a step


def training_recall(
    recordings: Sequence[Recording], pool: TuplePool, config: TrainConfig
) -> Callable[[Params], dict[str, float]]:
    """Return a function that scores weights by Recall@1 among fixed places of the training recordings.

    The places are pairs of an anchor and a positive, each rotated at random. A pair counts as found if the nearest of
    all positive descriptors belongs to a place within the positive distance of the anchor. The score says little about
    new places.
    """
    frames = pool.draw(seed=_SEED, step=0, tuples=PLACES)[:, :2]
    offset = pool.positions[frames[:, :1], :2] - pool.positions[None, frames[:, 1], :2]
    same_recording = pool.recording_of[frames[:, :1]] == pool.recording_of[None, frames[:, 1]]
    same_place = same_recording & (np.linalg.norm(offset, axis=-1) < pool.config.positive_m)
    angles = np.random.default_rng(_SEED).uniform(0, 2 * np.pi, frames.shape).astype(np.float32)

    def score(params: Params) -> dict[str, float]:
        places, rotations = frames.reshape(-1), angles.reshape(-1) * config.rotate
        descriptors = describe_places(params, recordings, pool, places, rotations, config)
        anchors, positives = descriptors.reshape(PLACES, 2, -1).transpose(1, 0, 2)
        nearest = (anchors @ positives.T).argmax(1)
        return {"score": float(same_place[np.arange(PLACES), nearest].mean())}

    return score


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
    queries = np.arange(len(pool))
    same_recording = pool.recording_of[:, None] == pool.recording_of[None]
    same_visit = same_recording & (np.abs(pool.frame_of[:, None] - pool.frame_of[None]) <= gap)
    distance_m = cdist(pool.positions[:, :2], pool.positions[:, :2])
    matches = same_recording & ~same_visit & (distance_m < pool.config.positive_m)
    descriptor_distance = np.where(same_visit, np.inf, cdist(descriptors, descriptors))
    nearest = descriptor_distance.argmin(1)
    is_match, has_match = matches[queries, nearest], matches.any(1)
    curve = decision_curve(
        -descriptor_distance[queries, nearest],
        true_if_accepted=is_match,
        false_if_accepted=pool.far_apart(queries, nearest),
        missed_if_rejected=has_match,
    )
    return float(is_match[has_match].mean()), curve.f1_max


def describe_places(
    params: Params,
    recordings: Sequence[Recording],
    pool: TuplePool,
    places: Int[np.ndarray, "n"],
    angles: Float[np.ndarray, "n"],
    config: TrainConfig,
) -> Float32[np.ndarray, "n d"]:
    """Describe places of the training recordings, given as frame numbers of the pool, each rotated about z by its
    angle in radians. Raises the errors of reading a scan."""
    descriptors = []
    for start in range(0, len(places), CHUNK):
        rows = np.arange(start, start + CHUNK).clip(max=len(places) - 1)  # the last batch is padded with its last place
        batch = read_batch(
            recordings,
            pool,
            places[rows][:, None],
            max_points=config.max_points,
            share_negatives=True,
            categories=config.model.categories_read,
            image=config.model.image,
        )
        descriptors.append(np.asarray(_describe(params, batch, jnp.asarray(angles[rows], jnp.float32))))
    return np.concatenate(descriptors)[: len(places)].astype(np.float32)


@jax.jit
def _describe(params: Params, batch: Batch, angles: Float[Array, "b"]) -> Float[Array, "b d"]:
    return describe(params, *views(batch, angles, params.config.grid))


def require_revisits(recordings: Sequence[Recording]) -> None:
    """Raise ValueError if a recording has no poses or no revisits."""
    for recording in recordings:
        if not revisits(positions_of(recording)[:, :2], times=recording.times, radius_m=FOUND_M).any():
            raise ValueError(
                f"sequence {recording.name}: expected revisits within {FOUND_M:g} m to score on, found none"
            )


def recall_at_1(
    descriptors: Float32[np.ndarray, "n d"],
    positions: Float[np.ndarray, "n 3"],
    times: Float[np.ndarray, " n"] | None,
    distance: DistanceFn,
) -> float:
    """Return the fraction of the revisits whose nearest descriptor, among frames older than 30 s, is within 5 m.

    Arguments:
      descriptors: Descriptor of each frame.
      positions: Position of each frame in metres. Distances are horizontal.
      times: Time of each frame in seconds. None: 290 frames replace 30 s.
      distance: Distance between descriptors.
    """
    places = positions[:, :2]
    queries = np.flatnonzero(revisits(places, times=times, radius_m=FOUND_M))
    ends = database_end(len(places), times=times)[queries]
    hits = 0
    for start in range(0, len(queries), QUERIES):
        rows, end = queries[start : start + QUERIES], ends[start : start + QUERIES]
        distances = distance(descriptors[rows], descriptors[: end.max()])
        nearest = np.where(np.arange(end.max())[None] < end[:, None], distances, np.inf).argmin(axis=1)
        hits += int((np.linalg.norm(places[rows] - places[nearest], axis=1) <= FOUND_M).sum())
    return hits / len(queries)
