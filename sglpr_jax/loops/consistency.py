"""Consistency of loops with each other and with the odometry.

Two loops and the odometry between their frames form a cycle. If it does not close within the drift and the loops' own
errors, one of them is wrong. After Mangelson et al., Pairwise Consistent Measurement Set Maximization (ICRA 2018).
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.loops.closure import (
    LoopClosure,
    Reason,
    RejectedClosure,
    compose,
    frames_of,
    inverse_planar,
    planar,
    planar_loops,
    relative,
)
from sglpr_jax.odometry.bev_odometry import BevOdometry
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.odometry.path import DrivenPath

BLOCK = 64
"""Number of loops compared with all others at a time, to limit memory."""
STARTS = 20
"""Number of loops from which the search for a consistent set starts."""
CYCLE_M, CYCLE_DEG = 0.5, 1.5
"""Standard deviations of a cycle in addition to the covariances of its loops, in metres and degrees."""
CYCLE_DEVIATIONS = 3.0
"""Maximum closure error of the cycle of two consistent loops, in standard deviations."""


def agree(
    loops: Sequence[LoopClosure],
    path: DrivenPath,
    others: Sequence[LoopClosure] | None = None,
    *,
    way: Float[np.ndarray, " n"] | None = None,
    drift: DriftModel = DriftModel(),
) -> Bool[np.ndarray, "a b"]:
    """Whether each loop is consistent with each of the `others`, by default with each of `loops`.

    All are between gravity-aligned frames. `way` is the travelled distance at each frame in metres, by default that of
    the path, whose length costs no time.
    """
    way = path.travelled if way is None else way
    a, b = (_columns(each, path, way) for each in (loops, loops if others is None else others))
    pairs = np.empty((len(a["query_way"]), len(b["query_way"])), bool)
    for start in range(0, len(pairs), BLOCK):
        rows = slice(start, start + BLOCK)
        pairs[rows] = _closes({name: values[rows] for name, values in a.items()}, b, drift)
    return pairs


def largest_consistent_set(pairs: Bool[np.ndarray, "n n"]) -> Int[np.ndarray, " k"]:
    """Indices, in order, of a large set in which every pair is consistent.

    The search is greedy, as the problem is NP-hard: it starts from each of the `STARTS` loops that are consistent with
    most others, and always adds the loop that leaves most candidates.
    """
    pairs = pairs & pairs.T
    degrees = pairs.sum(0)
    best = np.zeros(0, np.int64)
    for start in np.argsort(-degrees, kind="stable")[:STARTS]:
        members = _members_from(start, pairs, degrees)
        if len(members) > len(best):
            best = np.array(members)
        if len(best) > pairs.shape[0] / 2:
            break
    return np.sort(best)


def _members_from(start: np.int64, pairs: Bool[np.ndarray, "n n"], degrees: Int[np.ndarray, " n"]) -> list[np.int64]:
    """Greedy consistent set from `start`. `degrees` is the number of loops that each loop is consistent with."""
    members, chosen, left = [], start, np.ones(len(pairs), bool)
    while True:
        members.append(chosen)
        stay = left & pairs[chosen]
        stay[chosen] = False
        # Each loop is removed once, so updating the degrees costs as much in total as computing them once.
        degrees = degrees - pairs[left & ~stay].sum(0)
        left = stay
        if not left.any():
            return members
        chosen = np.argmax(np.where(left, degrees, -1))


def _columns(loops: Sequence[LoopClosure], path: DrivenPath, way: Float[np.ndarray, " n"]) -> dict[str, np.ndarray]:
    query, match = frames_of(loops)
    query_pose, match_pose = (planar(path.leveled(frames)) for frames in (query, match))
    poses, covariances = planar_loops(loops)
    return {
        "pose": poses,
        "query_pose": query_pose,
        "match_pose": match_pose,
        "query_way": way[query],
        "match_way": way[match],
        "place": covariances[:, 0, 0] + covariances[:, 1, 1],
        "turn": covariances[:, 2, 2],
    }


def _closes(a: dict[str, np.ndarray], b: dict[str, np.ndarray], drift: DriftModel) -> Bool[np.ndarray, "a b"]:
    """Whether the cycle of each loop of a with each loop of b closes, from their `_columns`."""
    # From a's query by odometry to b's query, by loop b to b's match, by odometry to a's match: should equal loop a.
    query_from_query = relative(a["query_pose"][:, None], b["query_pose"][None])
    match_from_match = relative(a["match_pose"][:, None], b["match_pose"][None])
    around = compose(match_from_match, compose(b["pose"][None], inverse_planar(query_from_query)))
    apart = relative(a["pose"][:, None], around)
    length = np.abs(a["query_way"][:, None] - b["query_way"]) + np.abs(a["match_way"][:, None] - b["match_way"])
    lever = np.hypot(query_from_query[..., 0], query_from_query[..., 1])
    turn = np.radians(CYCLE_DEG) ** 2 + a["turn"][:, None] + b["turn"][None]
    turn = turn + (np.radians(drift.degrees_per_metre) * length) ** 2
    place = CYCLE_M**2 + a["place"][:, None] + b["place"][None] + (drift.metres_per_metre * length) ** 2
    place = place + turn * lever**2
    close = apart[..., 0] ** 2 + apart[..., 1] ** 2 <= CYCLE_DEVIATIONS**2 * place
    return close & (np.abs(apart[..., 2]) <= CYCLE_DEVIATIONS * np.sqrt(turn))


MIN_LOOPS = 5
"""Minimum number of consistent loops between two sessions."""
MIN_TRAVELLED_M = 15.0
"""Minimum travelled distance between the first and the last of these loops, in each session, in metres."""
MAX_RIVAL = 0.5
"""Maximum size of the second largest consistent set, as a fraction of the largest one."""


def accepted_between(
    loops: Sequence[LoopClosure], motion: BevOdometry, *, drift: DriftModel
) -> tuple[list[list[LoopClosure]], list[RejectedClosure]]:
    """Accept sets of consistent loops between two sessions, at most one for each segment of each session.

    Arguments:
      loops: Loops between gravity-aligned frames, rows of the motion, in the order of their queries.
      motion: Motion of both sessions (`BevOdometry.joined`). Poses of different segments are not comparable.
      drift: Drift model of the motion.

    Returns:
      The accepted sets, the largest one first, and the rejected loops.
    """
    query, match = frames_of(loops)
    segments = np.stack([motion.segments[match], motion.segments[query]], axis=1)
    found, rejected = [], []
    for pair in np.unique(segments, axis=0):
        some = [loops[row] for row in np.flatnonzero((segments == pair).all(axis=1)).tolist()]
        pairs = agree(some, motion.path, way=motion.travelled, drift=drift)
        members = largest_consistent_set(pairs).tolist()
        others = np.setdiff1d(np.arange(len(some)), members)
        rival = largest_consistent_set(pairs[np.ix_(others, others)])
        chosen = [some[k] for k in members]
        reason: Reason = "contradicts other loops"
        ways = [np.ptp(motion.travelled[frames]) for frames in frames_of(chosen) if len(frames)]
        if len(chosen) < MIN_LOOPS or min(ways) < MIN_TRAVELLED_M:
            reason, others = "too few neighbours", np.arange(len(some))
        elif len(rival) > MAX_RIVAL * len(members):
            others = np.arange(len(some))
        else:
            found.append(chosen)
        rejected += [RejectedClosure(some[k], reason) for k in others]
    return sorted(found, key=len, reverse=True), rejected
