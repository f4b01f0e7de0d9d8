"""Sequential test: the log odds of neighbouring frames are added or subtracted.

The log odds of neighbouring frames are added if their matches move as their queries do, and subtracted if they match
elsewhere. Neighbours that see the same walls are not independent, so the weight of a frame depends on the distance
travelled since the previous one.
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
    """Selection and weights of neighbouring frames."""

    frames: int = 30
    """Number of frames before and after a loop that are considered."""
    support: int = 2
    """Minimum number of loops that show the same place, including the loop itself."""
    independent_m: float = 15.0
    """Travelled distance after which two frames are nearly independent, in metres."""
    least_probability: float = 0.2
    """Minimum probability of a neighbour. It counts with the excess of its log odds over those of this probability."""
    unknown_m: float = 1.0
    """Assumed distance between consecutive frames if the motion is unknown, in metres."""
    max_log_odds: float = 4.0
    """Maximum log odds that a neighbour adds or subtracts."""
    frames_a_frame: float = 3.0
    """If the motion is unknown, the matches of two queries k frames apart are at most this factor times k + 1 frames
    apart."""
    agree_m: float = 2.0
    agree_share: float = 0.1
    agree_deg: float = 10.0
    """Maximum closure error of the cycle of two loops that agree: distance in metres, additional fraction of the
    travelled distance, and angle in degrees."""
    guess_share: float = 0.075
    guess_deg_per_m: float = 0.2
    """Additional tolerance for each metre of `Motion.guessed_m`, in metres and degrees."""


def agree_in_order(loops: Sequence[Loop], *, config: SequenceConfig = SequenceConfig()) -> Bool[np.ndarray, "n n"]:
    """Whether each pair of loops agrees by frame numbers: the match moves as the query does, in either direction."""
    query, match = frames_of(loops)
    on = np.abs(query[:, None] - query[None])
    return np.abs(match[:, None] - match[None]) <= config.frames_a_frame * (on + 1)


def agree_in_motion(
    loops: Sequence[Loop], motion: Motion, mounting: Mounting | None, *, config: SequenceConfig = SequenceConfig()
) -> Bool[np.ndarray, "n n"]:
    """Whether each pair of loops agrees with the motion of the sensor and, if it is a guess, in frame numbers."""
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
    """Pose of each loop j predicted from loop i and the motion: (i, j) is match_j_from_query_j via loop i."""
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
    """Log odds of each loop, given its neighbours.

    Arguments:
      loops: Loops in the order of their queries.
      log_odds: Log odds of each loop alone.
      agreeing: Whether each pair of loops agrees.
      motion: Motion of all frames.
      config: Selection and weights of neighbours.
    """
    query, _ = frames_of(loops)
    gaps = _gaps(query, motion, config)
    counted = np.clip(log_odds - logit(config.least_probability), 0, config.max_log_odds)
    fresh = 1 - np.exp(-gaps / config.independent_m)
    towards = np.sign(np.arange(len(loops))[:, None] - np.arange(len(loops))[None])  # direction from j to i
    weight = np.where(towards > 0, fresh[None, 1:], np.where(towards < 0, fresh[None, :-1], 0.0))
    weight = weight * (np.abs(query[:, None] - query[None]) <= config.frames)
    return log_odds + (np.where(agreeing, 1.0, -1.0) * weight) @ counted


def _gaps(query: np.ndarray, motion: Motion, config: SequenceConfig) -> Float[np.ndarray, " m"]:
    """Distance travelled before each query, and after the last one. There is one more than queries."""
    between = [
        abs(motion.travelled[b] - motion.travelled[a])
        if motion.segments[a] == motion.segments[b]
        else config.unknown_m * (b - a)
        for a, b in zip(query[:-1].tolist(), query[1:].tolist(), strict=True)
    ]
    return np.array([0.0, *between, 0.0])
