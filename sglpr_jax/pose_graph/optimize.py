"""Correction of a trajectory by its loops: a pose graph, solved with gtsam (extra `gtsam`).

In least squares, every wrong loop bends the graph. Graduated non-convexity (Yang et al., RA-L 2020) ignores outliers.
The result is compared with the stated drift of the odometry.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.data.mounting import is_tilted
from sglpr_jax.files import warn
from sglpr_jax.loops.closure import LoopClosure, frames_of, to_upright
from sglpr_jax.loops.drift import deviations, step_deviations
from sglpr_jax.loops.result import LoopSearchResult, Session
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.pose_graph.factor_graph import FactorGraph, gtsam_library
from sglpr_jax.se3 import inverse

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
            reason = f"{len(self.inliers)} loops need more than {limit}" if len(self.inliers) else "no loops"
            return f"trajectory not corrected: {reason}"
        loops = f"{self.inliers.sum()} of {len(self.inliers)} loops"
        moved = f"{self.moved_m:.2f} m at most, {self.moved_rms_m:.2f} m RMS"
        return f"trajectory corrected by {loops}: moved by {moved}, {self.deviation:.2f} sigmas of the stated drift"


def optimize_trajectory(result: LoopSearchResult) -> OptimizedTrajectory:
    """Correct the odometry of all sessions by their loops, within the stated drift. Warns if heights move by metres.

    Sessions that loops connect get one frame, that of the first one. It takes about a second for a few hundred frames,
    and minutes for a few thousand.

    Raises:
      ValueError: If the loops were found without odometry.
      ImportError: If the extra `gtsam` is not installed.

    Example:
      found = find_loops(recording, params, odometry=odometry)
      corrected = optimize_trajectory(result).poses
    """
    without = next((session.recording.name for session in result.sessions if session.odometry is None), None)
    if without is not None:
        raise ValueError(f"{without}: expected loops found with odometry, found loops without it")
    placed = placements(result)
    poses, inliers = dict[int, np.ndarray](), np.zeros(len(result.loops), bool)
    solutions = []
    for group in dict.fromkeys(group for group, _ in placed):
        members = {session: pose for session, (other, pose) in enumerate(placed) if other == group}
        rows = [row for row, loop in enumerate(result.loops) if loop.query_session in members]
        solution, solved_poses = _solve_group(result, members, [result.loops[row] for row in rows])
        solutions.append(solution)
        inliers[rows] = solution.inliers
        poses |= solved_poses
        for session, corrected in solved_poses.items():
            _warn_of_heights(result.sessions[session], members[session], corrected)
    squares = sum(solution.moved_rms_m**2 * len(solution.poses) for solution in solutions)
    return OptimizedTrajectory(
        np.concatenate([poses[session] for session in range(len(result.sessions))]),
        inliers,
        max(solution.moved_m for solution in solutions),
        float(np.sqrt(squares / max(sum(len(solution.poses) for solution in solutions), 1))),
        max(solution.deviation for solution in solutions),
        solutions[0].drift,
    )


def _solve_group(
    result: LoopSearchResult, members: Mapping[int, Float[np.ndarray, "4 4"]], loops: Sequence[LoopClosure]
) -> tuple[OptimizedTrajectory, dict[int, Float[np.ndarray, "_ 4 4"]]]:
    """Solve the graph of connected sessions, given the pose of each session's frame in that of the first one.

    Returns the solution for the gravity-aligned frames, and the corrected poses of the LiDAR for each session.
    """
    sessions, (first, *_) = result.sessions, members
    upright_from_lidar = {k: sessions[k].recording.uprights[: sessions[k].frames] for k in members}
    upright = {}
    for k, first_from_session in members.items():
        odometry = np.asarray(sessions[k].odometry)[: sessions[k].frames]
        upright[k] = first_from_session @ odometry @ inverse(upright_from_lidar[k])
    level_from_first = np.eye(4)
    level_from_first[:3, :3] = DrivenPath(upright[first], tilted=is_tilted(upright_from_lidar[first])).level
    upright_loops = []
    for loop in loops:
        match, query = (sessions[node.session].recording.mounting_of(node.frame) for node in loop.nodes)
        upright_loops.append(to_upright(loop, query=query, match=match))
    levelled = {k: level_from_first @ poses for k, poses in upright.items()}
    solution = solved_graph(levelled, upright_loops, sessions[first].drift)
    parts = np.split(solution.poses, np.cumsum([len(poses) for poses in upright.values()])[:-1])
    first_from_level = inverse(level_from_first)
    lidar = {k: first_from_level @ part @ upright_from_lidar[k] for k, part in zip(members, parts, strict=True)}
    return solution, lidar


def _warn_of_heights(
    session: Session, first_from_session: Float[np.ndarray, "4 4"], corrected: Float[np.ndarray, "n 4 4"]
) -> None:
    """Warn if the correction moved a pose up or down by more than `MOST_RISEN_M`."""
    odometry = first_from_session @ np.asarray(session.odometry)[: session.frames]
    risen_m = np.abs(corrected - odometry)[:, 2, 3].max(initial=0)
    if risen_m > MOST_RISEN_M:
        warn(
            f"{session.recording.name}: expected heights near those of the odometry, found them moved by up to "
            f"{risen_m:.1f} m; only registered loops measure heights"
        )


def placements(result: LoopSearchResult) -> tuple[tuple[int, Float[np.ndarray, "4 4"]], ...]:
    """Return the group of each session, and the transform from its odometry frame to that of the group's first one.

    Groups are named by the number of their first session. Transforms with more loops are used first. Sessions without
    odometry, or without a common place, are groups of their own.
    """
    links = []
    for aligned in sorted(result.transforms, key=lambda aligned: -aligned.loops):
        if aligned.match.is_odometry:
            match, query, pose = aligned.match.session, aligned.query.session, aligned.match_from_query
            links += [(match, query, pose), (query, match, inverse(pose))]
    placed: dict[int, tuple[int, np.ndarray]] = {}
    for root in range(len(result.sessions)):
        placed.setdefault(root, (root, np.eye(4)))
        while link := next((link for link in links if link[0] in placed and link[1] not in placed), None):
            known, new, known_from_new = link
            group, first_from_known = placed[known]
            placed[new] = group, first_from_known @ known_from_new
    return tuple(placed[session] for session in range(len(result.sessions)))


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
    gtsam_library()  # also without loops
    sessions = np.repeat(list(odometry), [len(poses) for poses in odometry.values()])
    poses = np.concatenate(list(odometry.values()))
    first = {session: int(np.searchsorted(sessions, session)) for session in odometry}  # the sessions ascend
    loops = [
        dataclasses.replace(
            loop, match=first[loop.match_session] + loop.match, query=first[loop.query_session] + loop.query
        )
        for loop in loops
    ]
    used = _contradictions(loops, poses, sessions, drift) <= drift.max_deviation
    for _ in range(ROUNDS):
        if not used.any():
            break
        chosen = np.flatnonzero(used)
        solved, fits = _solve(poses, [loops[i] for i in chosen], sessions, drift)
        members = chosen[fits]
        bend = _bend(poses, solved, [loops[i] for i in members], sessions, drift)
        if (bend <= drift.max_deviation).all():
            moved = np.linalg.norm(solved[:, :3, 3] - poses[:, :3, 3], axis=1)
            rms, deviation = float(np.sqrt(np.mean(moved**2))), float(bend.max(initial=0))
            inliers = np.isin(np.arange(len(loops)), members)
            return OptimizedTrajectory(solved, inliers, float(moved.max()), rms, deviation, drift)
        used[members[bend > drift.max_deviation]] = False
    return OptimizedTrajectory(poses, np.zeros(len(loops), bool), drift=drift)


def _solve(
    odometry: Float[np.ndarray, "n 4 4"],
    loops: Sequence[LoopClosure],
    sessions: Int[np.ndarray, " n"],
    drift: DriftModel,
) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " k"]]:
    """The poses of the solution, and whether each loop is an inlier of it."""
    gtsam, graph = gtsam_library(), FactorGraph()
    for frame, pose in enumerate(odometry):
        graph.add_node(frame, pose, fixed=frame == 0)
    metres, radians = step_deviations(odometry, drift)
    # A large value keeps the graph solvable without loops between sessions.
    metres, radians = (np.where(np.diff(sessions), UNCONNECTED, deviation) for deviation in (metres, radians))
    for frame, step in enumerate(inverse(odometry[:-1]) @ odometry[1:]):
        graph.add_step(frame, frame + 1, step, metres=metres[frame], radians=radians[frame])
    certain = graph.factors.size()
    for loop in loops:
        graph.add_loop(loop.match, loop.query, loop.match_from_query, loop.covariance)
    options = gtsam.GncLMParams()
    options.setKnownInliers(list(range(certain)))
    solver = gtsam.GncLMOptimizer(graph.factors, graph.estimates, options)
    solution = solver.optimize()
    poses = np.stack([solution.atPose3(frame).matrix() for frame in range(len(odometry))])
    return poses, np.asarray(solver.getWeights())[certain:] > 0.5


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
    paths = [LoopClosure(int(b), int(a), inverse(poses[a]) @ poses[b], np.zeros((6, 6)), 1.0) for a, b in ends]
    deviation = _contradictions(paths, odometry, sessions, drift)
    of_loops, of_neighbours = deviation[: len(loops)], deviation[len(loops) :]
    bends = []
    for loop, between in zip(loops, of_loops, strict=True):
        is_end = np.isin(frames, [loop.match, loop.query])
        bends.append(max(between, *of_neighbours[is_end[:-1] | is_end[1:]], 0.0))
    return np.array(bends)


def trajectory_error(poses: Float[np.ndarray, "n 4 4"], positions: Float[np.ndarray, "n 3"]) -> float:
    """Root mean square distance of a trajectory from true positions, in metres, after rigid alignment."""
    estimated, true = (points - points.mean(axis=0) for points in (poses[:, :3, 3], positions))
    left, _, right = np.linalg.svd(estimated.T @ true)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return float(np.sqrt(np.square(estimated @ (left @ flip @ right) - true).sum(axis=1).mean()))
