"""Consistency of loops with each other and with the odometry.

Two loops and the odometry between their frames form a cycle. If it does not close within the drift and the loops' own
errors, one of them is wrong. After Mangelson et al., Pairwise Consistent Measurement Set Maximization (ICRA 2018).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.loops.closure import LoopClosure, Reason, RejectedClosure, frames_of, planar_measurements
from sglpr_jax.odometry.bev_odometry import BevOdometry
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.se3 import PlanarPose, compose_planar, inverse_planar, planar_pose

BLOCK = 64
"""Number of loops compared with all others at a time, to limit memory."""
STARTS = 20
"""Number of loops from which consistent sets are grown, one from each. The largest set counts."""
CYCLE_M, CYCLE_DEG = 0.5, 1.5
"""Standard deviations of a cycle in addition to the covariances of its loops, in metres and degrees."""
CYCLE_DEVIATIONS = 3.0
"""Maximum closure error of the cycle of two consistent loops, in standard deviations."""


def are_consistent(
    loops: Sequence[LoopClosure],
    path: DrivenPath,
    others: Sequence[LoopClosure] | None = None,
    *,
    travelled_m: Float[np.ndarray, " n"] | None = None,
    drift: DriftModel = DriftModel(),
) -> Bool[np.ndarray, "a b"]:
    """Whether each loop is consistent with each of the `others`, by default with each of `loops`.

    All loops are between gravity-aligned frames of `path`. `travelled_m` is the travelled distance at each frame, by
    default that of the path.
    """
    travelled_m = path.travelled if travelled_m is None else travelled_m
    loop_arrays = _loop_arrays(loops, path, travelled_m)
    other_arrays = loop_arrays if others is None else _loop_arrays(others, path, travelled_m)
    pairs = np.empty((len(loop_arrays.query_m), len(other_arrays.query_m)), bool)
    for start in range(0, len(pairs), BLOCK):
        rows = slice(start, start + BLOCK)
        block = _LoopArrays(*(field[rows] for field in loop_arrays))
        pairs[rows] = _cycles_close(block, other_arrays, drift)
    return pairs


class _LoopArrays(NamedTuple):
    """Loops as arrays, one row for each loop."""

    measured: PlanarPose
    """Pose of the query in the frame of the match."""
    query_pose: PlanarPose
    match_pose: PlanarPose
    """Poses of query and match by odometry."""
    query_m: Float[np.ndarray, " n"]
    match_m: Float[np.ndarray, " n"]
    """Travelled distance at query and match, in metres."""
    position_variance: Float[np.ndarray, " n"]
    yaw_variance: Float[np.ndarray, " n"]
    """Variances of the measured pose, in square metres and square radians."""


def _loop_arrays(loops: Sequence[LoopClosure], path: DrivenPath, travelled_m: Float[np.ndarray, " n"]) -> _LoopArrays:
    query, match = frames_of(loops)
    measured, covariances = planar_measurements(loops)
    return _LoopArrays(
        measured,
        query_pose=planar_pose(path.leveled(query)),
        match_pose=planar_pose(path.leveled(match)),
        query_m=travelled_m[query],
        match_m=travelled_m[match],
        position_variance=covariances[:, 0, 0] + covariances[:, 1, 1],
        yaw_variance=covariances[:, 2, 2],
    )


def _cycles_close(a: _LoopArrays, b: _LoopArrays, drift: DriftModel) -> Bool[np.ndarray, "a b"]:
    """Whether the cycle of each loop of a, each loop of b and the odometry between their frames closes.

    Loop a should equal the rest: by odometry from a's match to b's match, by loop b, by odometry from b's query to a's.
    """
    query_a_from_b = compose_planar(inverse_planar(a.query_pose)[:, None], b.query_pose[None])
    match_a_from_b = compose_planar(inverse_planar(a.match_pose)[:, None], b.match_pose[None])
    predicted = compose_planar(match_a_from_b, compose_planar(b.measured[None], inverse_planar(query_a_from_b)))
    error = compose_planar(inverse_planar(a.measured)[:, None], predicted)
    length_m = np.abs(a.query_m[:, None] - b.query_m) + np.abs(a.match_m[:, None] - b.match_m)
    yaw_variance = np.radians(CYCLE_DEG) ** 2 + a.yaw_variance[:, None] + b.yaw_variance
    yaw_variance += (np.radians(drift.degrees_per_metre) * length_m) ** 2
    variance = (
        CYCLE_M**2 + a.position_variance[:, None] + b.position_variance + (drift.metres_per_metre * length_m) ** 2
    )
    # An error in yaw moves the end of the cycle in proportion to the distance between the two queries.
    variance += yaw_variance * np.hypot(query_a_from_b[..., 0], query_a_from_b[..., 1]) ** 2
    position_closes = error[..., 0] ** 2 + error[..., 1] ** 2 <= CYCLE_DEVIATIONS**2 * variance
    return position_closes & (np.abs(error[..., 2]) <= CYCLE_DEVIATIONS * np.sqrt(yaw_variance))


def largest_consistent_set(pairs: Bool[np.ndarray, "n n"]) -> Int[np.ndarray, " k"]:
    """Indices, in order, of a large set of loops in which every pair is consistent.

    Finding the largest set is NP-hard, so the search is greedy: it starts from each of the `STARTS` loops that are
    consistent with most others, and adds the loop that leaves most candidates. It stops at a set of more than half of
    the loops.
    """
    pairs = pairs & pairs.T
    degrees = pairs.sum(0)  # number of loops with which each loop is consistent
    best = np.zeros(0, np.int64)
    for start in np.argsort(-degrees, kind="stable")[:STARTS]:
        members = _members_from(start, pairs, degrees)
        if len(members) > len(best):
            best = np.array(members)
        if len(best) > pairs.shape[0] / 2:
            break
    return np.sort(best)


def _members_from(start: np.int64, pairs: Bool[np.ndarray, "n n"], degrees: Int[np.ndarray, " n"]) -> list[np.int64]:
    """Greedy consistent set from `start`. `degrees` is the number of loops with which each loop is consistent."""
    members, newest, candidates = [], start, np.ones(len(pairs), bool)
    while True:
        members.append(newest)
        remaining = candidates & pairs[newest]
        remaining[newest] = False
        # Count only candidates. Each is removed once, so all updates together cost as much as counting once.
        degrees = degrees - pairs[candidates & ~remaining].sum(0)
        candidates = remaining
        if not candidates.any():
            return members
        newest = np.argmax(np.where(candidates, degrees, -1))


MIN_LOOPS = 5
"""Minimum number of consistent loops between two sessions."""
MIN_TRAVELLED_M = 15.0
"""Minimum travelled distance between the first and the last of these loops, in each session, in metres."""
MAX_RIVAL = 0.5
"""Maximum size of the second largest consistent set, as a fraction of the largest one."""


def accept_between(
    loops: Sequence[LoopClosure], motion: BevOdometry, *, drift: DriftModel, known: int = 0
) -> tuple[list[list[LoopClosure]], list[RejectedClosure]]:
    """Accept sets of consistent loops between two sessions, at most one for each pair of their segments.

    Arguments:
      loops: Loops between gravity-aligned frames, rows of the motion, in the order of their queries.
      motion: Motion of both sessions (`BevOdometry.joined`). Relative poses are known only within its segments.
      drift: Drift model of the motion.
      known: Number of first frames whose poses do not drift, such as those of a map.

    Returns:
      The accepted sets, the largest one first, and the rejected loops.
    """
    query, match = frames_of(loops)
    segments = np.stack([motion.segments[match], motion.segments[query]], axis=1)
    drifting_m = motion.travelled.copy()
    drifting_m[:known] = 0
    accepted, rejected = [], []
    for segment_pair in np.unique(segments, axis=0):
        members = [loops[row] for row in np.flatnonzero((segments == segment_pair).all(axis=1)).tolist()]
        all_rows = np.arange(len(members))
        pairs = are_consistent(members, motion.path, travelled_m=drifting_m, drift=drift)
        largest = largest_consistent_set(pairs).tolist()
        other_rows = np.setdiff1d(all_rows, largest)
        rival = largest_consistent_set(pairs[np.ix_(other_rows, other_rows)])
        consistent = [members[row] for row in largest]
        lengths_m = [np.ptp(motion.travelled[frames]) for frames in frames_of(consistent)]
        reason: Reason = "contradicts other loops"
        if len(consistent) < MIN_LOOPS or min(lengths_m) < MIN_TRAVELLED_M:
            reason, rejected_rows = "too few neighbours", all_rows
        elif len(rival) > MAX_RIVAL * len(consistent):
            rejected_rows = all_rows
        else:
            accepted.append(consistent)
            rejected_rows = other_rows
        rejected += [RejectedClosure(members[row], reason) for row in rejected_rows]
    return sorted(accepted, key=len, reverse=True), rejected
