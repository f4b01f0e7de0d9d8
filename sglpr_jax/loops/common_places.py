"""Acceptance of loops between two recordings: all accepted loops must fit one transform between the two frames.

Without a common frame there is no odometry from one recording to the other that could contradict a loop. Therefore a
set of loops is accepted only as a whole, if it is large, long, and has no large rival.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.loops.config import ConsistencyConfig, DriftModel
from sglpr_jax.loops.consistency import agree, largest_consistent_set
from sglpr_jax.loops.loop import Loop, Reason, Rejected
from sglpr_jax.loops.planar import frames_of

MIN_LOOPS = 5
"""Minimum number of consistent loops between two recordings."""
MIN_TRAVELLED_M = 15.0
"""Minimum travelled distance between the first and the last of these loops, in each recording, in metres."""
MAX_RIVAL = 0.5
"""Maximum size of the second largest consistent set, as a fraction of the largest one."""


class Joined(NamedTuple):
    """Poses of the frames of both recordings, one after the other. Poses of different parts are not comparable."""

    poses: Float[np.ndarray, "n 4 4"]
    """Pose of the gravity-aligned frame of the sensor at each frame."""
    travelled: Float[np.ndarray, " n"]
    """Travelled distance at each frame, in metres."""
    parts: Int[np.ndarray, " n"]
    """Part of each frame. Parts are separated where the motion is unknown, and between the recordings."""


def accepted_between(
    loops: Sequence[Loop], joined: Joined, *, drift: DriftModel, config: ConsistencyConfig
) -> tuple[list[list[Loop]], list[Rejected]]:
    """Accept sets of consistent loops, at most one for each part of one recording and each part of the other.

    Arguments:
      loops: Loops in gravity-aligned frames, in the order of their queries.
      joined: Poses of both recordings.
      drift: Drift model of the poses.
      config: Thresholds of the consistency of two loops.

    Returns:
      The accepted sets, the largest one first, and the rejected loops.
    """
    query, match = frames_of(loops)
    pairs_of_parts = np.stack([joined.parts[match], joined.parts[query]], axis=1)
    found, rejected = [], []
    for parts in np.unique(pairs_of_parts, axis=0):
        rows = np.flatnonzero((pairs_of_parts == parts).all(axis=1)).tolist()
        some = [loops[row] for row in rows]
        pairs = agree(some, joined.poses, way=joined.travelled, drift=drift, config=config)
        members = largest_consistent_set(pairs).tolist()
        others = np.setdiff1d(np.arange(len(some)), members)
        rival = largest_consistent_set(pairs[np.ix_(others, others)])
        chosen = [some[k] for k in members]
        reason: Reason = "contradicts other loops"
        if not _is_enough(chosen, joined):
            reason, others = "too few neighbours", np.arange(len(some))
        elif len(rival) > MAX_RIVAL * len(members):
            others = np.arange(len(some))
        else:
            found.append(chosen)
        rejected += [Rejected(some[k], reason) for k in others]
    return sorted(found, key=len, reverse=True), rejected


def _is_enough(loops: Sequence[Loop], joined: Joined) -> bool:
    """Whether there are enough loops, over enough travelled distance in both recordings."""
    if len(loops) < MIN_LOOPS:
        return False
    return all(np.ptp(joined.travelled[frames]) >= MIN_TRAVELLED_M for frames in frames_of(loops))
