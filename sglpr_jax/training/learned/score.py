"""Score of a learned method on held-out recordings: Recall@1 of revisits. Rate search and learning curves use it."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Float32

from sglpr_jax.data.recording import Recording
from sglpr_jax.methods.learned.describe import describe_inputs
from sglpr_jax.methods.learned.distance import learned_distance
from sglpr_jax.methods.learned.method import LearnedMethod, Variables
from sglpr_jax.methods.method import DistanceFn
from sglpr_jax.revisits import database_end, revisits
from sglpr_jax.training.learned.inputs import Prepared

RECALL = "recall_at_1"
FOUND_M = 5.0
"""Maximum distance of a right answer, in metres."""
QUERIES = 256
"""Number of queries that are compared at a time."""

ScoreFn = Callable[[Variables], dict[str, float]]
"""Scores weights. The entry `recall_at_1` selects among them."""


def held_out_score(method: LearnedMethod, held_out: Prepared) -> ScoreFn:
    """Return a function that scores weights on held-out recordings.

    The entries of a score are `recall_at_1`, the mean, and `recall_at_1 NAME` for each recording.

    Raises ValueError if a recording has no revisits.
    """
    require_revisits(held_out.recordings)

    def score(variables: Variables) -> dict[str, float]:
        distance, found = learned_distance(method, variables), {}
        for recording, inputs in zip(held_out.recordings, held_out.inputs, strict=True):
            descriptors = describe_inputs(method, variables, inputs)
            assert recording.positions is not None
            recall = recall_at_1(descriptors, recording.positions, recording.times, distance)
            found[f"{RECALL} {recording.name}"] = recall
        return {RECALL: float(np.mean(list(found.values()))), **found}

    return score


def require_revisits(recordings: Sequence[Recording]) -> None:
    """Raise ValueError if a recording has no poses or no revisits."""
    for recording in recordings:
        if recording.positions is None:
            raise ValueError(f"sequence {recording.name} has no poses; training and scoring need them")
        if not revisits(recording.positions[:, :2], times=recording.times, radius_m=FOUND_M).any():
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
        rows, last = queries[start : start + QUERIES], ends[start : start + QUERIES]
        apart = distance(descriptors[rows], descriptors[: last.max()])
        nearest = np.where(np.arange(last.max())[None] < last[:, None], apart, np.inf).argmin(axis=1)
        hits += int((np.linalg.norm(places[rows] - places[nearest], axis=1) <= FOUND_M).sum())
    return hits / len(queries)
