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
from sglpr_jax.models.sglpr import describe
from sglpr_jax.models.weights import Params
from sglpr_jax.revisits import database_end, revisits
from sglpr_jax.training.batches import Batch, read_batch, views
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.tuples import TuplePool, positions_of, tuple_pool

CHUNK = 16
"""Number of places that are described at a time."""
PAIRS = 192
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

    The places are pairs of an anchor and a positive, each rotated at random. An anchor counts as found if the most
    similar of all positives is within the positive distance. The score says little about new places.
    """
    pairs = pool.draw(seed=_SEED, step=0, tuples=PAIRS)[:, :2]
    anchors, positives = pairs[:, 0], pairs[:, 1]
    distance_m = cdist(pool.separated[anchors], pool.separated[positives])
    is_match = distance_m < pool.config.positive_m  # (anchor, positive)
    angles = np.random.default_rng(_SEED).uniform(0, 2 * np.pi, pairs.shape).astype(np.float32)

    def score(params: Params) -> dict[str, float]:
        places, rotations = pairs.reshape(-1), angles.reshape(-1) * config.rotate
        descriptors = describe_places(params, recordings, pool, places, rotations, config)
        anchor_descriptors, positive_descriptors = descriptors.reshape(PAIRS, 2, -1).transpose(1, 0, 2)
        nearest = (anchor_descriptors @ positive_descriptors.T).argmax(1)
        return {"score": float(is_match[np.arange(PAIRS), nearest].mean())}

    return score


def validation_score(
    recordings: Sequence[Recording], frames: Sequence[Int[np.ndarray, "_"]], config: TrainConfig
) -> Callable[[Params], dict[str, float]]:
    """Return a function that scores weights by retrieval among the held-out `frames` of each recording.

    Every frame is a query, rotated at random, and all other frames are its database. `recall_neighbours` is Recall@1
    within the positive distance. If there are revisits, `recall_revisits` (Recall@1) and `f1max` exclude frames of the
    same visit, and "score" is their mean. Otherwise "score" is `recall_neighbours`.

    Raises ValueError if no two held-out frames are within the positive distance.
    """
    try:
        pool = tuple_pool(recordings, config.sampling, frames=frames)
    except ValueError as error:
        raise ValueError(f"the part held out by validation.share is too small: {error}") from error
    angles = np.random.default_rng(_SEED).uniform(0, 2 * np.pi, len(pool)) * config.rotate
    places = np.arange(len(pool))

    def score(params: Params) -> dict[str, float]:
        descriptors = describe_places(params, recordings, pool, places, angles, config)
        neighbours, _ = recall_and_f1_max(descriptors, pool)
        if not len(pool.revisits.anchors):
            return {"score": neighbours, "recall_neighbours": neighbours}
        revisits, f1_max = recall_and_f1_max(descriptors, pool, revisits_only=True)
        score = (revisits + f1_max) / 2
        return {"score": score, "recall_neighbours": neighbours, "recall_revisits": revisits, "f1max": f1_max}

    return score


def recall_and_f1_max(
    descriptors: Float32[np.ndarray, "n d"], pool: TuplePool, *, revisits_only: bool = False
) -> tuple[float, float]:
    """Return Recall@1 and top-1 F1max. Every place of the pool is a query, and `descriptors` are those of its places.

    The database of a query has all other places or, with `revisits_only`, those of other visits. A match is in the same
    world and within the positive distance. Recall@1 counts queries with a match; there must be at least one. F1max
    accepts the nearest place up to a threshold on the descriptor distance: a match is right, a place beyond the
    negative distance is wrong.
    """
    places = np.arange(len(pool))
    nearest, distance = np.zeros_like(places), np.zeros(len(pool))
    nearest_is_match, has_match = np.zeros((2, len(pool)), bool)
    for start in range(0, len(pool), QUERIES):
        rows = slice(start, start + QUERIES)
        queries = places[rows, None]
        excluded = pool.are_of_one_visit(queries, places[None]) if revisits_only else queries == places[None]
        is_match = ~excluded & (cdist(pool.separated[rows], pool.separated) < pool.config.positive_m)  # (query, place)
        distances = np.where(excluded, np.inf, cdist(descriptors[rows], descriptors))
        nearest[rows], distance[rows], has_match[rows] = distances.argmin(1), distances.min(1), is_match.any(1)
        nearest_is_match[rows] = np.take_along_axis(is_match, nearest[rows, None], axis=1)[:, 0]
    curve = decision_curve(
        -distance,
        true_if_accepted=nearest_is_match,
        false_if_accepted=pool.far_apart(places, nearest),
        missed_if_rejected=has_match,
    )
    return float(nearest_is_match[has_match].mean()), curve.f1_max


def describe_places(
    params: Params,
    recordings: Sequence[Recording],
    pool: TuplePool,
    places: Int[np.ndarray, "n"],
    angles: Float[np.ndarray, "n"],
    config: TrainConfig,
) -> Float32[np.ndarray, "n d"]:
    """Describe places of training recordings, given as numbers of the pool, after rotations about z in radians."""
    descriptors = []
    for start in range(0, len(places), CHUNK):
        # The last chunk repeats its last place, so that every chunk has one shape and compiles once.
        rows = np.arange(start, start + CHUNK).clip(max=len(places) - 1)
        batch = read_batch(
            recordings,
            pool,
            places[rows][:, None],
            max_points=config.max_points,
            share_negatives=True,
            categories=config.model.categories_read,
            image=config.model.image,
        )
        descriptors.append(np.asarray(_describe_batch(params, batch, jnp.asarray(angles[rows], jnp.float32))))
    return np.concatenate(descriptors)[: len(places)].astype(np.float32)


@jax.jit
def _describe_batch(params: Params, batch: Batch, angles: Float[Array, "b"]) -> Float[Array, "b d"]:
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

    All frames are of one recording. `positions` are in metres, and distances between them are horizontal. `times` are
    in seconds; without them, 290 frames replace 30 s (`revisits.database_end`). `distance` compares descriptors.
    """
    plane = positions[:, :2]
    queries = np.flatnonzero(revisits(plane, times=times, radius_m=FOUND_M))
    database_ends = database_end(len(plane), times=times)[queries]
    hits = 0
    for start in range(0, len(queries), QUERIES):
        block, ends = queries[start : start + QUERIES], database_ends[start : start + QUERIES]
        distances = distance(descriptors[block], descriptors[: ends.max()])
        in_database = np.arange(ends.max())[None] < ends[:, None]  # (query, frame)
        nearest = np.where(in_database, distances, np.inf).argmin(axis=1)
        hits += int((np.linalg.norm(plane[block] - plane[nearest], axis=1) <= FOUND_M).sum())
    return hits / len(queries) if len(queries) else np.nan
