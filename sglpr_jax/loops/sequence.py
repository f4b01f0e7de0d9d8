"""Sequential test: the log odds of neighbouring frames are added or subtracted.

The log odds of neighbouring frames are added if their matches move as their queries do, and subtracted if they match
elsewhere. Neighbours that see the same walls are not independent, so the weight of a frame depends on the distance
travelled since the previous one.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import logit

from sglpr_jax.loops.config import SequenceConfig
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.motion import Motion
from sglpr_jax.loops.mountings import AnyMounting
from sglpr_jax.loops.planar import Planar, compose, frames_of, inverted, planar, planar_loops, wrapped


def agree_in_order(loops: Sequence[Loop], *, config: SequenceConfig = SequenceConfig()) -> Bool[np.ndarray, "n n"]:
    """Whether each pair of loops agrees by frame numbers: the match moves as the query does, in either direction."""
    query, match = frames_of(loops)
    on = np.abs(query[:, None] - query[None])
    return np.abs(match[:, None] - match[None]) <= config.frames_a_frame * (on + 1)


def agree_in_motion(
    loops: Sequence[Loop], motion: Motion, mounting: AnyMounting, *, config: SequenceConfig = SequenceConfig()
) -> Bool[np.ndarray, "n n"]:
    """Whether each pair of loops agrees with the motion of the sensor and, if it is a guess, in frame numbers."""
    query, match = frames_of(loops)
    segment = motion.segments
    known = segment[query][:, None] == segment[query][None]
    known = known & (segment[match][:, None] == segment[match][None])
    fitted, _ = planar_loops(loops, mounting)
    poses = planar(motion.poses[np.concatenate([query, match])])
    expected = _moved(fitted, poses[: len(loops)], poses[len(loops) :])
    apart = compose(inverted(expected), np.broadcast_to(fitted[None], expected.shape))
    length, guess = (
        sum(np.abs(way[frames][:, None] - way[frames][None]) for frames in (query, match))
        for way in (motion.travelled, motion.guessed_m)
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
