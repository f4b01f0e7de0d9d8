"""Correction of a trajectory by its loops: a pose graph, solved with gtsam (extra `gtsam`).

In least squares, every wrong loop bends the graph. Graduated non-convexity (Yang et al., RA-L 2020) ignores outliers.
The result is compared with the stated drift of the odometry.
"""

import dataclasses
import importlib
import itertools
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.data.levelling import is_tilted, uprights
from sglpr_jax.data.warning import warn
from sglpr_jax.loops.closure import LoopClosure, frames_of, to_upright
from sglpr_jax.loops.drift import deviations, step_deviations
from sglpr_jax.loops.result import LoopSearchResult
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.se3 import inverse

FIRST_POSE = 1e-6
"""Standard deviation of the first pose, which stays fixed, in metres and radians."""
MOST_RISEN_M = 2.0
"""Maximum correction of a height without a warning, in metres."""
UNCONNECTED = 1e2
"""Standard deviation of the motion between two sessions, in metres and radians."""
ROUNDS = 5
"""Maximum number of solutions. Before each next one, loops that bend the solution beyond the drift are dropped."""


class OptimizedTrajectory(NamedTuple):
    """A corrected trajectory, and its distance from the odometry."""

    poses: Float[np.ndarray, "n 4 4"]
    """Pose of the LiDAR at each searched frame of one session after the other (`LoopSearchResult.split`), in the
    odometry frame of the first session that loops connect with it. The first pose is not changed."""
    inliers: Bool[np.ndarray, " k"]
    """Whether the corrected trajectory agrees with each loop."""
    moved_m: float = 0.0
    moved_rms_m: float = 0.0
    """Distance between corrected and given positions, maximum and root mean square, in metres."""
    deviation: float = 0.0
    """Largest deviation of the corrected trajectory from the odometry, in sigmas of the stated drift (`deviations`),
    over the paths between the two frames of an inlier and between consecutive frames of inliers."""
    drift: DriftModel = DriftModel()
    """Stated drift."""

    def __str__(self) -> str:
        if not self.inliers.any():
            limit = f"{self.drift.max_deviation:g} sigmas of the stated drift ({self.drift})"
            why = f"{len(self.inliers)} loops need more than {limit}" if len(self.inliers) else "no loops"
            return f"trajectory not corrected: {why}"
        loops = f"{self.inliers.sum()} of {len(self.inliers)} loops"
        moved = f"{self.moved_m:.2f} m at most, {self.moved_rms_m:.2f} m RMS"
        return f"trajectory corrected by {loops}: moved by {moved}, {self.deviation:.2f} sigmas of the stated drift"


def optimize_trajectory(found: LoopSearchResult) -> OptimizedTrajectory:
    """Correct the odometry of all sessions by their loops, within the stated drift. Warns if heights move by metres.

    Sessions that loops connect get one frame, that of the first one. It takes about a second for a few hundred frames,
    and minutes for a few thousand.

    Raises:
      ValueError: If the loops were found without odometry.
      ImportError: If the extra `gtsam` is not installed.

    Example:
      found = find_loops(recording, params, odometry=odometry)
      corrected = optimize_trajectory(found).poses
    """
    without = next((one.recording.name for one in found.sessions if one.odometry is None), None)
    if without is not None:
        raise ValueError(f"{without}: expected loops found with odometry, found loops without it")
    placed, sessions = placements(found), found.sessions
    poses, inliers = dict[int, np.ndarray](), np.zeros(len(found.loops), bool)
    solved = []
    for group in dict.fromkeys(group for group, _ in placed):
        members = {number: to_first for number, (other, to_first) in enumerate(placed) if other == group}
        rows = [row for row, loop in enumerate(found.loops) if loop.query_session in members]
        turned = {number: uprights(sessions[number].recording)[: sessions[number].frames] for number in members}
        given = {number: np.asarray(sessions[number].odometry)[: sessions[number].frames] for number in members}
        upright = {number: members[number] @ given[number] @ inverse(turned[number]) for number in members}
        level = np.eye(4)
        level[:3, :3] = DrivenPath(upright[group], tilted=is_tilted(turned[group])).level
        loops = []
        for row in rows:
            match, query = (sessions[one.session].recording.mounting_of(one.frame) for one in found.loops[row].nodes)
            loops.append(to_upright(found.loops[row], query=query, match=match))
        solved.append(solved_graph({k: level @ one for k, one in upright.items()}, loops, sessions[group].drift))
        inliers[rows] = solved[-1].inliers
        ends = np.cumsum([len(one) for one in upright.values()])[:-1]
        for number, one in zip(members, np.split(solved[-1].poses, ends), strict=True):
            poses[number] = inverse(level) @ one @ turned[number]
            risen_m = np.abs(poses[number] - members[number] @ given[number])[:, 2, 3].max(initial=0)
            if risen_m > MOST_RISEN_M:
                warn(
                    f"{sessions[number].recording.name}: expected heights near those of the odometry, found them moved "
                    f"by up to {risen_m:.1f} m; only registered loops measure heights"
                )
    moved = [one.moved_rms_m**2 * len(one.poses) for one in solved]
    return OptimizedTrajectory(
        np.concatenate([poses[number] for number in range(len(found.sessions))]),
        inliers,
        max(one.moved_m for one in solved),
        float(np.sqrt(sum(moved) / max(sum(len(one.poses) for one in solved), 1))),
        max(one.deviation for one in solved),
        solved[0].drift,
    )


def placements(found: LoopSearchResult) -> tuple[tuple[int, Float[np.ndarray, "4 4"]], ...]:
    """Return the group of each session, and the transform from its odometry frame to that of the group's first one.

    Groups are named by the number of their first session. Transforms with more loops are used first. Sessions without
    odometry, or without a common place, are groups of their own.
    """
    placed: dict[int, tuple[int, np.ndarray]] = {}
    links = sorted((one for one in found.transforms if one.match.is_odometry), key=lambda one: -one.loops)
    ends = [
        (known, new, pose)
        for one in links
        for known, new, pose in (
            (one.match.session, one.query.session, one.match_from_query),
            (one.query.session, one.match.session, inverse(one.match_from_query)),
        )
    ]
    for root in range(len(found.sessions)):
        placed.setdefault(root, (root, np.eye(4)))
        while link := next((one for one in ends if one[0] in placed and one[1] not in placed), None):
            known, new, known_from_new = link
            group, first_from_known = placed[known]
            placed[new] = group, first_from_known @ known_from_new
    return tuple(placed[number] for number in range(len(found.sessions)))


def solved_graph(
    odometry: Mapping[int, Float[np.ndarray, "_ 4 4"]], loops: Sequence[LoopClosure], drift: DriftModel = DriftModel()
) -> OptimizedTrajectory:
    """Solve the pose graph of sessions in one gravity-aligned frame.

    Loops that contradict the odometry are dropped. If the solution contradicts the odometry between the frames of a
    loop, that loop is dropped, too, and the graph is solved again, up to `ROUNDS` times. If a contradiction remains,
    the odometry is returned without inliers. Loops between two sessions, where no odometry is, cannot contradict it.

    Arguments:
      odometry: Pose of the sensor at each frame, for each session. Consecutive frames are connected.
      loops: Loops between the gravity-aligned frames of these sessions.
      drift: Stated drift of the odometry.

    Raises ImportError if the extra `gtsam` is not installed.
    """
    gtsam = gtsam_library()
    sessions = np.repeat(list(odometry), [len(one) for one in odometry.values()])
    poses = np.concatenate(list(odometry.values()))
    first = {session: int(np.searchsorted(sessions, session)) for session in odometry}  # the sessions ascend
    loops = [
        dataclasses.replace(one, match=first[one.match_session] + one.match, query=first[one.query_session] + one.query)
        for one in loops
    ]
    used = _contradictions(loops, poses, sessions, drift) <= drift.max_deviation
    for _ in range(ROUNDS):
        if not used.any():
            break
        chosen = np.flatnonzero(used)
        solved, fits = _solved(gtsam, poses, [loops[i] for i in chosen], sessions, drift)
        members = chosen[fits]
        bend = _bend(poses, solved, [loops[i] for i in members], sessions, drift)
        if (bend <= drift.max_deviation).all():
            moved = np.linalg.norm(solved[:, :3, 3] - poses[:, :3, 3], axis=1)
            rms, deviation = float(np.sqrt(np.mean(moved**2))), float(bend.max(initial=0))
            inliers = np.isin(np.arange(len(loops)), members)
            return OptimizedTrajectory(solved, inliers, float(moved.max()), rms, deviation, drift)
        used[members[bend > drift.max_deviation]] = False
    return OptimizedTrajectory(poses, np.zeros(len(loops), bool), drift=drift)


def _solved(
    gtsam: ModuleType,
    odometry: Float[np.ndarray, "n 4 4"],
    loops: Sequence[LoopClosure],
    sessions: Int[np.ndarray, " n"],
    drift: DriftModel,
) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " k"]]:
    """The poses of the solution, and whether each loop is an inlier of it."""
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for frame, pose in enumerate(odometry):
        start.insert(frame, gtsam.Pose3(pose))
    graph.add(first_factor(odometry[0]))
    metres, radians = step_deviations(odometry, drift)
    # A large value keeps the graph solvable without loops between sessions.
    metres, radians = (np.where(np.diff(sessions), UNCONNECTED, one) for one in (metres, radians))
    for frame, pose in enumerate(inverse(odometry[:-1]) @ odometry[1:]):
        graph.add(step_factor(frame, frame + 1, pose, metres[frame], radians[frame]))
    certain = graph.size()
    for loop in loops:
        noise = gtsam.noiseModel.Gaussian.Covariance(rotation_first(loop.covariance))
        graph.add(gtsam.BetweenFactorPose3(loop.match, loop.query, gtsam.Pose3(loop.match_from_query), noise))
    options = gtsam.GncLMParams()
    options.setKnownInliers(list(range(certain)))
    solver = gtsam.GncLMOptimizer(graph, start, options)
    solution = solver.optimize()
    poses = np.stack([solution.atPose3(frame).matrix() for frame in range(len(odometry))])
    return poses, np.asarray(solver.getWeights())[certain:] > 0.5


def first_factor(pose: Float[np.ndarray, "4 4"]) -> Any:
    """Factor of gtsam that fixes the pose of node 0."""
    gtsam = gtsam_library()
    return gtsam.PriorFactorPose3(0, gtsam.Pose3(pose), gtsam.noiseModel.Isotropic.Sigma(6, FIRST_POSE))


def step_factor(before: int, after: int, step: Float[np.ndarray, "4 4"], metres: float, radians: float) -> Any:
    """Factor of gtsam between two nodes that odometry connects, with standard deviations (`step_deviations`)."""
    gtsam = gtsam_library()
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([radians, metres], 3))
    return gtsam.BetweenFactorPose3(before, after, gtsam.Pose3(step), noise)


def _contradictions(
    loops: Sequence[LoopClosure],
    odometry: Float[np.ndarray, "n 4 4"],
    sessions: Int[np.ndarray, " n"],
    drift: DriftModel,
) -> Float[np.ndarray, " k"]:
    """Deviation of each loop from the odometry (`deviations`). It is 0 for loops between two sessions."""
    query, match = frames_of(loops)
    return np.where(sessions[query] == sessions[match], deviations(loops, DrivenPath(odometry), drift=drift), 0.0)


def _bend(
    odometry: Float[np.ndarray, "n 4 4"],
    poses: Float[np.ndarray, "n 4 4"],
    loops: Sequence[LoopClosure],
    sessions: Int[np.ndarray, " n"],
    drift: DriftModel,
) -> Float[np.ndarray, " k"]:
    """Deviation of the solved poses from the odometry at each loop, in standard deviations.

    It is the largest one along the path between the two frames of the loop, and along the paths from each of them to
    the next earlier and later frame of any loop.
    """
    frames = np.unique([frame for loop in loops for frame in (loop.match, loop.query)])
    ends = [(loop.match, loop.query) for loop in loops] + list(itertools.pairwise(frames))
    solved = [LoopClosure(int(b), int(a), inverse(poses[a]) @ poses[b], np.zeros((6, 6)), 1.0) for a, b in ends]
    found = _contradictions(solved, odometry, sessions, drift)
    bends = []
    for k, loop in enumerate(loops):
        own = np.isin(frames, [loop.match, loop.query])  # a path that starts or ends at one of these counts
        bends.append(max(found[k], *found[len(loops) :][own[:-1] | own[1:]], 0.0))
    return np.array(bends)


def trajectory_error(poses: Float[np.ndarray, "n 4 4"], positions: Float[np.ndarray, "n 3"]) -> float:
    """Root mean square distance of a trajectory from true positions, in metres, after rigid alignment."""
    found, true = (each - each.mean(axis=0) for each in (poses[:, :3, 3], positions))
    left, _, right = np.linalg.svd(found.T @ true)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return float(np.sqrt(np.square(found @ (left @ flip @ right) - true).sum(axis=1).mean()))


def rotation_first(covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """Return the covariance with rotation before translation, as in gtsam."""
    order = np.array([3, 4, 5, 0, 1, 2])
    return covariance[np.ix_(order, order)]


def check_installed() -> None:
    """Raises ImportError if the extra `gtsam` is not installed."""
    gtsam_library()


def gtsam_library() -> ModuleType:
    """Import gtsam. Raises ImportError if the extra `gtsam` is not installed."""
    try:
        return importlib.import_module("gtsam")
    except ImportError as error:
        raise ImportError("optimisation of a trajectory needs gtsam: pip install 'sglpr-jax[gtsam]'") from error
