"""Sequential test: what neighbouring frames say about a pair.

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
from sglpr_jax.loops.consistency import agree
from sglpr_jax.loops.probability import Evidence, LoopModel
from sglpr_jax.odometry.bev_odometry import BevOdometry
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.odometry.path import DrivenPath

WINDOW_M = 50.0
"""Travelled distance before and after a query within which other queries are its neighbours, in metres."""
BLOCK = 64
"""Number of pairs that are tested at a time, to limit memory."""


class Pair(NamedTuple):
    """Two frames that may be a loop."""

    loop: LoopClosure
    """The pair between gravity-aligned frames, with its probability alone."""
    evidence: Evidence
    way_m: float
    """Travelled distance at the query, in metres."""


def pair_of(
    one: Candidate, model: LoopModel, motion: BevOdometry, mountings: Sequence[Mounting | None], *, knows_height: bool
) -> Pair:
    """The pair of a candidate. `knows_height`: whether the odometry measures height."""
    probability, sensors = float(model.probability(one.evidence)), (mountings[one.query], mountings[one.match])
    about = {"probability": probability, "knows_height": knows_height, "sensors": sensors}
    return Pair(planar_loop(*one[:3], **about), one.evidence, float(motion.travelled[one.query]))


def probable_loops(
    pairs: Sequence[Pair], model: LoopModel, path: DrivenPath, *, drift: DriftModel, config: DetectorConfig
) -> list[LoopClosure | None]:
    """For each pair, the loop with its probability given the neighbours, or None below `config.min_probability`.

    The pairs are in the order of their queries. `path` and its `drift` are those of all frames.
    """
    found = tested_log_odds(pairs, model, path, drift=drift, config=config)
    least = logit(config.min_probability)
    return [
        dataclasses.replace(one.loop, probability=float(expit(value))) if value >= least else None
        for one, value in zip(pairs, found, strict=True)
    ]


def tested_log_odds(
    pairs: Sequence[Pair],
    model: LoopModel,
    path: DrivenPath,
    *,
    drift: DriftModel,
    config: DetectorConfig = DetectorConfig(),
) -> Float[np.ndarray, " n"]:
    """Log odds of pairs, given their neighbours and the motion. The arguments are those of `probable_loops`."""
    if not pairs:
        return np.zeros(0)
    evidence = Evidence.stack([one.evidence for one in pairs])
    strength, support = model.strength(evidence), np.empty(len(pairs))
    loops, way_m = [one.loop for one in pairs], np.maximum.accumulate([one.way_m for one in pairs])
    for start in range(0, len(pairs), BLOCK):
        end = min(start + BLOCK, len(pairs))
        first = int(np.searchsorted(way_m, way_m[start] - WINDOW_M))
        last = int(np.searchsorted(way_m, way_m[end - 1] + WINDOW_M, side="right"))
        agreeing = agree(loops[start:end], path, loops[first:last], drift=drift)
        weights = neighbour_weights(way_m[first:last], np.arange(start, end) - first)
        support[start:end] = (np.where(agreeing, 1.0, -1.0) * weights) @ strength[first:last]
    return model.tested_log_odds(evidence, support)


def neighbour_weights(way_m: Float[np.ndarray, " n"], rows: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k n"]:
    """Weight of each pair as neighbour of the pairs in `rows`: the share of it that is new on the way to them.

    `way_m` is the travelled distance at each query, in metres, in increasing order.
    """
    fresh = 1 - np.exp(-np.concatenate([[0.0], np.diff(way_m), [0.0]]) / INDEPENDENT_M)
    before = rows[:, None] > np.arange(len(way_m))[None]
    weight = np.where(before, fresh[None, 1:], fresh[None, :-1]) * (rows[:, None] != np.arange(len(way_m))[None])
    return weight * (np.abs(way_m[rows][:, None] - way_m[None]) <= WINDOW_M)


def verdict(pair: Pair, model: LoopModel, min_probability: float) -> Reason:
    """Reason why a pair is no loop that the motion allows and the sequential test rejects."""
    if float(model.log_odds(pair.evidence)) > 0:
        return "too few neighbours"
    alone = pair.evidence._replace(ambiguity_ratio=np.zeros(()))  # as if no other pose and place fitted as well
    return "repeats" if float(model.log_odds(alone)) >= logit(min_probability) else "little similarity"
