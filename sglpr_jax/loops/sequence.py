"""The sequential test: the loops of neighbouring frames add up, or speak against each other.

The log odds of a loop are its own, plus those of the frames about it whose matches move as their queries do, less those
of frames that match elsewhere. Neighbours that see the same walls are not independent: a frame counts as much as the
sensor moved since the one before.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import logit

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.motion import Motion
from sglpr_jax.loops.planar import Planar, compose, frames_of, inverted, planar, planar_loops, wrapped


@dataclasses.dataclass(frozen=True)
class SequenceConfig:
    """Which frames count, and how much."""

    frames: int = 30
    """Number of frames before and after a loop that count."""
    support: int = 2
    """Minimum number of loops that show the same place, including the loop itself."""
    independent_m: float = 15.0
    """Travelled distance at which two frames are about independent, in metres."""
    least_probability: float = 0.2
    """A neighbour counts by how much its log odds exceed those of this probability."""
    unknown_m: float = 1.0
    """Distance from one frame to the next if the motion is not known, in metres."""
    max_log_odds: float = 4.0
    """A neighbour counts at most this much."""
    frames_a_frame: float = 3.0
    """If the motion is not known, matches of queries k frames apart are at most this factor times k + 1 apart."""
    agree_m: float = 2.0
    agree_share: float = 0.1
    agree_deg: float = 10.0
    """Two loops agree if their circle closes within this distance, plus this share of the travelled distance, and
    within this angle."""
    guess_share: float = 0.075
    guess_deg_per_m: float = 0.2
    """What is added to both for each metre of `Motion.guessed_m`, in metres and degrees."""


def agree_in_order(loops: Sequence[Loop], *, config: SequenceConfig = SequenceConfig()) -> Bool[np.ndarray, "n n"]:
    """Which pairs of loops agree by their frames alone: the match moves as the query does, in either direction."""
    query, match = frames_of(loops)
    on = np.abs(query[:, None] - query[None])
    return np.abs(match[:, None] - match[None]) <= config.frames_a_frame * (on + 1)


def agree_in_motion(
    loops: Sequence[Loop], motion: Motion, mounting: Mounting | None, *, config: SequenceConfig = SequenceConfig()
) -> Bool[np.ndarray, "n n"]:
    """Which pairs of loops agree by the motion of the sensor; where that is a guess, by their frames, too."""
    query, match = frames_of(loops)
    segment = np.array(motion.segments)
    known = segment[query][:, None] == segment[query][None]
    known = known & (segment[match][:, None] == segment[match][None])
    fitted, _ = planar_loops(loops, mounting)
    poses = planar(np.stack(motion.poses)[np.concatenate([query, match])])
    expected = _moved(fitted, poses[: len(loops)], poses[len(loops) :])
    apart = compose(inverted(expected), np.broadcast_to(fitted[None], expected.shape))
    length, guess = (
        sum(np.abs(way[frames][:, None] - way[frames][None]) for frames in (query, match))
        for way in (np.array(motion.travelled), np.array(motion.guessed_m))
    )
    metres = config.agree_m + config.agree_share * length + config.guess_share * guess
    close = np.hypot(apart[..., 0], apart[..., 1]) <= metres
    degrees = config.agree_deg + config.guess_deg_per_m * guess
    close = close & (np.abs(wrapped(apart[..., 2])) <= np.radians(degrees))
    return close & (known | agree_in_order(loops, config=config))


def _moved(fitted: Planar, query: Planar, match: Planar) -> Planar:
    """Where the motion puts each loop j, given loop i: (i, j) is match_j_from_query_j by way of loop i."""
    query_from_query = compose(inverted(query)[:, None], query[None])
    match_from_match = compose(inverted(match)[None], match[:, None])
    return compose(match_from_match, compose(fitted[:, None], query_from_query))


def added_log_odds(
    loops: Sequence[Loop],
    log_odds: Float[np.ndarray, " n"],
    agreeing: Bool[np.ndarray, "n n"],
    motion: Motion,
    *,
    config: SequenceConfig = SequenceConfig(),
) -> Float[np.ndarray, " n"]:
    """The log odds of each loop, given those of the others.

    Arguments:
      loops: In the order of their queries.
      log_odds: Of each loop alone.
      agreeing: Which pairs show the same place.
      motion: Of all frames.
    """
    query, _ = frames_of(loops)
    gaps = _gaps(query, motion, config)
    counted = np.clip(log_odds - logit(config.least_probability), 0, config.max_log_odds)
    fresh = 1 - np.exp(-gaps / config.independent_m)
    towards = np.sign(np.arange(len(loops))[:, None] - np.arange(len(loops))[None])  # of i, seen from j
    weight = np.where(towards > 0, fresh[None, 1:], np.where(towards < 0, fresh[None, :-1], 0.0))
    weight = weight * (np.abs(query[:, None] - query[None]) <= config.frames)
    return log_odds + (np.where(agreeing, 1.0, -1.0) * weight) @ counted


def _gaps(query: np.ndarray, motion: Motion, config: SequenceConfig) -> Float[np.ndarray, " m"]:
    """How far the sensor moved before each query, and after the last: one more than there are queries."""
    between = [
        abs(motion.travelled[b] - motion.travelled[a])
        if motion.segments[a] == motion.segments[b]
        else config.unknown_m * (b - a)
        for a, b in zip(query[:-1].tolist(), query[1:].tolist(), strict=True)
    ]
    return np.array([0.0, *between, 0.0])
