"""Sequential test: the evidence of neighbouring pairs is added to that of a pair.

Two pairs are neighbours if their queries are at most `WINDOW_M` apart. Neighbours support a pair if their loops are
consistent with it, and oppose it otherwise. Neighbours that see the same walls are not independent, so the weight of a
neighbour depends on the distance travelled until the next one.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import expit, logit

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.loops.closure import LoopClosure, Reason, planar_loop
from sglpr_jax.loops.comparison import Candidate
from sglpr_jax.loops.config import INDEPENDENT_M, DetectorConfig
from sglpr_jax.loops.consistency import are_consistent
from sglpr_jax.loops.probability import Evidence, LoopModel
from sglpr_jax.odometry.bev_odometry import BevOdometry
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.odometry.path import DrivenPath

WINDOW_M = 50.0
"""Maximum travelled distance between the queries of two neighbouring pairs, in metres."""
BLOCK = 64
"""Number of pairs that are tested at a time, to limit memory."""


class Pair(NamedTuple):
    """Two frames that may be a loop."""

    loop: LoopClosure
    """The loop closure between gravity-aligned frames, with its probability without neighbours."""
    evidence: Evidence
    travelled_m: float
    """Travelled distance at the query, in metres."""


def pair_of(
    candidate: Candidate,
    model: LoopModel,
    motion: BevOdometry,
    mountings: Sequence[Mounting | None],
    *,
    knows_height: bool,
) -> Pair:
    """Convert a candidate to a pair, with its probability without neighbours.

    `mountings` are those of all frames of the motion. `knows_height` is False if the odometry does not measure height.
    """
    query, match, registration, evidence = candidate
    probability = float(model.probability(evidence))
    options = {"knows_height": knows_height, "sensors": (mountings[query], mountings[match])}
    loop = planar_loop(query, match, registration, probability=probability, **options)
    return Pair(loop, evidence, float(motion.travelled[query]))


def probable_loops(
    pairs: Sequence[Pair], model: LoopModel, path: DrivenPath, *, drift: DriftModel, config: DetectorConfig
) -> list[LoopClosure | None]:
    """For each pair, the loop with its probability given the neighbours, or None below `config.min_probability`.

    The pairs are in the order of their queries. `path` and its `drift` are those of all frames.
    """
    loops, min_log_odds = list[LoopClosure | None](), logit(config.min_probability)
    for pair, log_odds in zip(pairs, tested_log_odds(pairs, model, path, drift=drift), strict=True):
        is_probable = log_odds >= min_log_odds
        loops.append(dataclasses.replace(pair.loop, probability=float(expit(log_odds))) if is_probable else None)
    return loops


def tested_log_odds(
    pairs: Sequence[Pair], model: LoopModel, path: DrivenPath, *, drift: DriftModel
) -> Float[np.ndarray, " n"]:
    """Log odds of each pair given its neighbours. The arguments are those of `probable_loops`."""
    if not pairs:
        return np.zeros(0)
    evidence = Evidence.stack([pair.evidence for pair in pairs])
    strength, support = model.strength(evidence), np.empty(len(pairs))
    loops = [pair.loop for pair in pairs]
    travelled_m = np.maximum.accumulate([pair.travelled_m for pair in pairs])  # increases, for the binary search
    for start in range(0, len(pairs), BLOCK):
        end = min(start + BLOCK, len(pairs))
        first = int(np.searchsorted(travelled_m, travelled_m[start] - WINDOW_M))
        last = int(np.searchsorted(travelled_m, travelled_m[end - 1] + WINDOW_M, side="right"))
        consistent = are_consistent(loops[start:end], path, loops[first:last], drift=drift)
        weights = neighbour_weights(travelled_m[first:last], np.arange(start, end) - first)
        signs = np.where(consistent, 1.0, -1.0)  # an inconsistent neighbour opposes the pair
        support[start:end] = (signs * weights) @ strength[first:last]
    return model.tested_log_odds(evidence, support)


def neighbour_weights(travelled_m: Float[np.ndarray, " n"], rows: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k n"]:
    """Weight of each of n pairs as neighbour of each of the pairs in `rows`: 0 beyond `WINDOW_M`, and for itself.

    The weight is a share from 0 to 1 that grows with the travelled distance from the neighbour to the next pair in the
    direction of the pair in `rows`. `travelled_m` is that at each query, in metres, in increasing order.
    """
    neighbours = np.arange(len(travelled_m))[None]
    # A step of d metres has the independent share 1 - exp(-d / INDEPENDENT_M). There are no steps beyond the ends.
    independent = 1 - np.exp(-np.concatenate([[0.0], np.diff(travelled_m), [0.0]]) / INDEPENDENT_M)
    to_previous, to_next = independent[None, :-1], independent[None, 1:]
    weight = np.where(neighbours < rows[:, None], to_next, to_previous)
    is_near = np.abs(travelled_m[rows][:, None] - travelled_m[None]) <= WINDOW_M
    return weight * (is_near & (rows[:, None] != neighbours))


def rejection_reason(pair: Pair, model: LoopModel, min_probability: float) -> Reason:
    """Reason why the sequential test rejected a pair that the motion allows."""
    if float(model.log_odds(pair.evidence)) > 0:
        return "too few neighbours"
    unambiguous = pair.evidence._replace(ambiguity_ratio=np.zeros(()))
    return "repeats" if float(model.log_odds(unambiguous)) >= logit(min_probability) else "little similarity"
