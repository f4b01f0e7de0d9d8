"""Sequential test: the evidence of neighbouring frames is added to that of a pair.

Neighbouring pairs support a pair if their matches move as their queries do, and oppose it otherwise. Neighbours that
see the same walls are not independent, so the weight of a frame depends on the distance travelled since the last one.
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
"""Travelled distance before and after a query within which other queries are its neighbours, in metres."""
BLOCK = 64
"""Number of pairs that are tested at a time, to limit memory."""


class Pair(NamedTuple):
    """Two frames that may be a loop."""

    loop: LoopClosure
    """The pair between gravity-aligned frames, with its probability without neighbours."""
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
    """The pair of a candidate. `knows_height`: whether the odometry measures height."""
    query, match, registration, evidence = candidate
    probability = float(model.probability(evidence))
    about = {"knows_height": knows_height, "sensors": (mountings[query], mountings[match])}
    loop = planar_loop(query, match, registration, probability=probability, **about)
    return Pair(loop, evidence, float(motion.travelled[query]))


def probable_loops(
    pairs: Sequence[Pair], model: LoopModel, path: DrivenPath, *, drift: DriftModel, config: DetectorConfig
) -> list[LoopClosure | None]:
    """For each pair, the loop with its probability given the neighbours, or None below `config.min_probability`.

    The pairs are in the order of their queries. `path` and its `drift` are those of all frames.
    """
    log_odds = tested_log_odds(pairs, model, path, drift=drift)
    return [
        dataclasses.replace(pair.loop, probability=float(expit(value)))
        if value >= logit(config.min_probability)
        else None
        for pair, value in zip(pairs, log_odds, strict=True)
    ]


def tested_log_odds(
    pairs: Sequence[Pair], model: LoopModel, path: DrivenPath, *, drift: DriftModel
) -> Float[np.ndarray, " n"]:
    """Log odds of pairs, given their neighbours and the motion. The arguments are those of `probable_loops`."""
    if not pairs:
        return np.zeros(0)
    evidence = Evidence.stack([pair.evidence for pair in pairs])
    strength, support = model.strength(evidence), np.empty(len(pairs))
    loops, travelled_m = [pair.loop for pair in pairs], np.maximum.accumulate([pair.travelled_m for pair in pairs])
    for start in range(0, len(pairs), BLOCK):
        end = min(start + BLOCK, len(pairs))
        first = int(np.searchsorted(travelled_m, travelled_m[start] - WINDOW_M))
        last = int(np.searchsorted(travelled_m, travelled_m[end - 1] + WINDOW_M, side="right"))
        consistent = are_consistent(loops[start:end], path, loops[first:last], drift=drift)
        weights = neighbour_weights(travelled_m[first:last], np.arange(start, end) - first)
        support[start:end] = (np.where(consistent, 1.0, -1.0) * weights) @ strength[first:last]
    return model.tested_log_odds(evidence, support)


def neighbour_weights(travelled_m: Float[np.ndarray, " n"], rows: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k n"]:
    """Weight of each of n pairs as neighbour of the pairs in `rows`.

    The weight grows with the distance that the sensor travels from a neighbour towards the pair until the next one.
    `travelled_m` is the travelled distance at each query, in metres, in increasing order.
    """
    others = np.arange(len(travelled_m))[None]
    independent = 1 - np.exp(-np.concatenate([[0.0], np.diff(travelled_m), [0.0]]) / INDEPENDENT_M)
    weight = np.where(rows[:, None] > others, independent[None, 1:], independent[None, :-1])
    is_near = np.abs(travelled_m[rows][:, None] - travelled_m[None]) <= WINDOW_M
    return weight * (is_near & (rows[:, None] != others))


def rejection_reason(pair: Pair, model: LoopModel, min_probability: float) -> Reason:
    """Reason why the sequential test rejected a pair that the motion allows."""
    if float(model.log_odds(pair.evidence)) > 0:
        return "too few neighbours"
    unambiguous = pair.evidence._replace(ambiguity_ratio=np.zeros(()))
    return "repeats" if float(model.log_odds(unambiguous)) >= logit(min_probability) else "little similarity"
