"""Sequential test: the evidence of neighbouring frames is added or subtracted.

The log odds of neighbouring pairs are added if their matches move as their queries do, and subtracted if they match
elsewhere. Neighbours that see the same walls are not independent, so the weight of a frame depends on the distance
travelled since the previous one. The motion between the two passes is common to all neighbours, and counts once.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import logit

from sglpr_jax.loops.config import ConsistencyConfig, DriftModel, SequenceConfig
from sglpr_jax.loops.consistency import agree_along
from sglpr_jax.loops.driven_path import DrivenPath
from sglpr_jax.loops.loop import Loop, Reason
from sglpr_jax.loops.mountings import AnyMounting
from sglpr_jax.loops.probability import Evidence, LoopModel

BLOCK = 64
"""Number of pairs that are tested at a time, to limit memory."""


class Pair(NamedTuple):
    """Two frames that may be a loop."""

    loop: Loop
    """The pair with its probability alone."""
    evidence: Evidence
    way_m: float
    """Travelled distance at the query, in metres."""


def tested_log_odds(
    pairs: Sequence[Pair],
    model: LoopModel,
    path: DrivenPath,
    *,
    mounting: AnyMounting,
    drift: DriftModel,
    consistency: ConsistencyConfig = ConsistencyConfig(),
    config: SequenceConfig = SequenceConfig(),
) -> Float[np.ndarray, " n"]:
    """Log odds of pairs, given their neighbours and the motion.

    Arguments:
      pairs: Pairs in the order of their queries.
      model: Model of the probabilities.
      path: Path of all frames.
      mounting: Mounting of the sensor, or that at each frame.
      drift: Drift model of the path.
      consistency: Thresholds of the agreement of two pairs.
      config: Selection and weights of neighbours.
    """
    if not pairs:
        return np.zeros(0)
    evidence = Evidence.stack([one.evidence for one in pairs])
    own, found = model.log_odds_of_images(evidence), np.empty(len(pairs))
    loops, way_m = [one.loop for one in pairs], np.maximum.accumulate([one.way_m for one in pairs])
    for start in range(0, len(pairs), BLOCK):
        end = min(start + BLOCK, len(pairs))
        first = int(np.searchsorted(way_m, way_m[start] - config.window_m))
        last = int(np.searchsorted(way_m, way_m[end - 1] + config.window_m, side="right"))
        options = {"mounting": mounting, "drift": drift, "config": consistency}
        agreeing = agree_along(path, loops[start:end], loops[first:last], **options)
        rows = np.arange(start, end) - first
        found[start:end] = added_log_odds(own[first:last], agreeing, way_m[first:last], rows, config=config)
    return model.log_odds(evidence) + found


def added_log_odds(
    log_odds: Float[np.ndarray, " n"],
    agreeing: Bool[np.ndarray, "k n"],
    way_m: Float[np.ndarray, " n"],
    rows: np.ndarray,
    *,
    config: SequenceConfig = SequenceConfig(),
) -> Float[np.ndarray, " k"]:
    """Log odds that the neighbours of some pairs add to these.

    Arguments:
      log_odds: Log odds of each pair alone, without the motion.
      agreeing: Whether each of `rows` agrees with each pair: their matches move as their queries do.
      way_m: Travelled distance at each query, in metres, in increasing order.
      rows: The k pairs whose log odds are computed.
      config: Selection and weights of neighbours.
    """
    counted = np.clip(log_odds, 0, config.max_log_odds)
    fresh = 1 - np.exp(-np.concatenate([[0.0], np.diff(way_m), [0.0]]) / config.independent_m)
    before = rows[:, None] > np.arange(len(way_m))[None]
    weight = np.where(before, fresh[None, 1:], fresh[None, :-1]) * (rows[:, None] != np.arange(len(way_m))[None])
    weight = weight * (np.abs(way_m[rows][:, None] - way_m[None]) <= config.window_m)
    return (np.where(agreeing, 1.0, -1.0) * weight) @ counted


def verdict(pair: Pair, model: LoopModel, min_probability: float) -> Reason:
    """Reason why a pair is no loop that the motion allows and the sequential test rejects."""
    if float(model.log_odds(pair.evidence)) > 0:
        return "too few neighbours"
    repeats = float(model.log_odds_without_ambiguity(pair.evidence)) >= logit(min_probability)
    return "repeats" if repeats else "little similarity"
