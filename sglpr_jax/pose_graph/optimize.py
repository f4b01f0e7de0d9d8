"""Correction of a trajectory by its loops: a pose graph, solved with gtsam (extra `gtsam`).

Graduated non-convexity (Yang et al., RA-L 2020) ignores wrong loops, which would bend a least-squares solution. The
result is compared with the drift of the odometry.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.data.mounting import is_tilted
from sglpr_jax.files import warn
from sglpr_jax.loops.closure import LoopClosure, frames_of, renumbered, to_upright
from sglpr_jax.loops.odometry_deviation import deviations, step_deviations
from sglpr_jax.loops.result import LoopSearchResult
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.pose_graph.factor_graph import FactorGraph, gtsam_library
from sglpr_jax.se3 import inverse

MAX_HEIGHT_CHANGE_M = 2.0
"""Maximum correction of a height without a warning, in metres."""
UNKNOWN_MOTION_SIGMA = 1e2
"""Standard deviation of the unknown motion between two sessions, in metres and radians."""
OUTLIER_COST = 50.0
"""Half of the squared error, in standard deviations, at which a loop is an outlier. 8.4 would be its own 99 % quantile
(6 degrees of freedom), but the odometry that the loop bends costs as much as the loop, and more if its noise is larger
than stated. Loops are wrong by metres, so they cost hundreds."""
ROUNDS = 5
"""Maximum number of solutions. Loops that bend a solution beyond the drift are dropped before the next one."""


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
    """Largest deviation of the corrected trajectory from the odometry, in sigmas of the drift (`deviations`),
    over the paths between the two frames of an inlier and between consecutive frames of inliers."""
    drift: DriftModel = DriftModel()
    """Drift of the odometry. With several sessions, the largest value of each number."""

    def __str__(self) -> str:
        if not self.inliers.any():
            limit = f"{self.drift.max_deviation:g} sigmas of the drift ({self.drift})"
            reason = f"{len(self.inliers)} loops need more than {limit}" if len(self.inliers) else "no loops"
            return f"trajectory not corrected: {reason}"
        loops = f"{self.inliers.sum()} of {len(self.inliers)} loops"
        moved = f"{self.moved_m:.2f} m at most, {self.moved_rms_m:.2f} m RMS"
        return f"trajectory corrected by {loops}: moved by {moved}, {self.deviation:.2f} sigmas of the drift"


def optimize_trajectory(result: LoopSearchResult) -> OptimizedTrajectory:
    """Correct the odometry of all sessions by their loops, within its drift.

    Warns if loops that are not registered, and so measure no heights, move heights by metres.

    Sessions that loops connect get one frame, that of the first one. The call takes about
    a second for a few hundred frames, and minutes for a few thousand.

    Raises:
      ValueError: If the loops were found without odometry.
      ImportError: If the extra `gtsam` is not installed.

    Example:
      result = find_loops(recording, params, odometry=odometry)
      corrected = optimize_trajectory(result).poses
    """
    for session in result.sessions:
        if session.odometry is None:
            raise ValueError(f"{session.recording.name}: expected loops found with odometry, found loops without it")
    placed = placements(result)
    poses: dict[int, np.ndarray] = {}  # by session
    inliers = np.zeros(len(result.loops), bool)
    solutions = []  # one for each group of connected sessions
    for group in dict.fromkeys(group for group, _ in placed):
        members = {session: pose for session, (its_group, pose) in enumerate(placed) if its_group == group}
        rows = [row for row, loop in enumerate(result.loops) if loop.query_session in members]
        solution, solved_poses = _solve_group(result, members, [result.loops[row] for row in rows])
        solutions.append(solution)
        inliers[rows] = solution.inliers
        poses |= solved_poses
    squared_m2 = sum(solution.moved_rms_m**2 * len(solution.poses) for solution in solutions)
    return OptimizedTrajectory(
        poses=np.concatenate([poses[session] for session in range(len(result.sessions))]),
        inliers=inliers,
        moved_m=max(solution.moved_m for solution in solutions),
        moved_rms_m=float(np.sqrt(squared_m2 / max(sum(len(solution.poses) for solution in solutions), 1))),
        deviation=max(solution.deviation for solution in solutions),
        drift=DriftModel.largest(*(solution.drift for solution in solutions)),
    )


def _solve_group(
    result: LoopSearchResult, members: Mapping[int, Float[np.ndarray, "4 4"]], loops: Sequence[LoopClosure]
) -> tuple[OptimizedTrajectory, dict[int, Float[np.ndarray, "_ 4 4"]]]:
    """Solve the pose graph of one group of connected sessions.

    Arguments:
      result: Result of the loop search.
      members: Sessions of the group, with the pose of each one's odometry frame in that of the first.
      loops: Loops between frames of these sessions.

    Returns:
      The solution for the gravity-aligned frames of the sensor, and the corrected poses of the LiDAR by session.
    """
    sessions = result.sessions
    first = next(iter(members))
    upright_from_lidar = {k: sessions[k].recording.uprights[: sessions[k].frames] for k in members}
    upright = {}
    for k, first_from_session in members.items():
        odometry = np.asarray(sessions[k].odometry)[: sessions[k].frames]
        upright[k] = first_from_session @ odometry @ inverse(upright_from_lidar[k])
    level_from_first = np.eye(4)  # rotation of the first odometry frame to a level one
    level_from_first[:3, :3] = DrivenPath(upright[first], tilted=is_tilted(upright_from_lidar[first])).level
    upright_loops = []
    for loop in loops:
        match, query = (sessions[node.session].recording.mounting_of(node.frame) for node in loop.nodes)
        upright_loops.append(to_upright(loop, query=query, match=match))
    levelled = {k: level_from_first @ poses for k, poses in upright.items()}
    solution = solve_pose_graph(levelled, upright_loops, {k: sessions[k].drift for k in members})
    session_poses = np.split(solution.poses, np.cumsum([len(poses) for poses in upright.values()])[:-1])
    if any(loop.overlap is None for loop in loops):
        for k, corrected in zip(members, session_poses, strict=True):
            _warn_of_height_change(sessions[k].recording.name, levelled[k], corrected)
    first_from_level = inverse(level_from_first)
    lidar_poses = {
        k: first_from_level @ poses @ upright_from_lidar[k] for k, poses in zip(members, session_poses, strict=True)
    }
    return solution, lidar_poses


def _warn_of_height_change(
    name: str, odometry: Float[np.ndarray, "n 4 4"], corrected: Float[np.ndarray, "n 4 4"]
) -> None:
    """Warn if a height changed by more than `MAX_HEIGHT_CHANGE_M`. The poses are in a level frame."""
    height_change_m = np.abs(corrected - odometry)[:, 2, 3].max(initial=0)
    if height_change_m > MAX_HEIGHT_CHANGE_M:
        warn(
            f"{name}: expected heights near those of the odometry, found them moved by up to "
            f"{height_change_m:.1f} m; only registered loops measure heights, and some are not registered"
        )


def placements(result: LoopSearchResult) -> tuple[tuple[int, Float[np.ndarray, "4 4"]], ...]:
    """Group the sessions that common places connect.

    Returns for each session the number of its group, which is that of the group's first session, and the pose of its
    odometry frame in that of this first session. A session without odometry or common places is a group of its own.
    """
    links = []
    for aligned in sorted(result.transforms, key=lambda aligned: -aligned.loops):  # the most reliable first
        if aligned.match.is_odometry and aligned.query.is_odometry:
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


def solve_pose_graph(
    odometry: Mapping[int, Float[np.ndarray, "_ 4 4"]],
    loops: Sequence[LoopClosure],
    drifts: Mapping[int, DriftModel] | None = None,
) -> OptimizedTrajectory:
    """Solve the pose graph of sessions in one gravity-aligned frame.

    Loops that contradict the odometry are dropped first. If the solution contradicts the odometry at a loop
    (`_deviations_at_loops`), that loop is dropped, too, and the graph is solved again, up to `ROUNDS` times. If a
    contradiction remains, the odometry is returned without inliers. Loops between two sessions cannot contradict it.

    Arguments:
      odometry: Pose of the sensor at each frame, for each session. Consecutive frames are connected.
      loops: Loops between the gravity-aligned frames of these sessions.
      drifts: Drift of the odometry of each session; the default model if omitted.

    Raises ImportError if the extra `gtsam` is not installed.
    """
    gtsam_library()  # raises the ImportError even if there are no loops
    drifts = drifts or dict.fromkeys(odometry, DriftModel())
    drift = DriftModel.largest(*drifts.values())
    sessions = np.repeat(list(odometry), [len(poses) for poses in odometry.values()])  # of each pose
    poses = np.concatenate(list(odometry.values()))
    rows = {session: np.flatnonzero(sessions == session) for session in odometry}
    loops = [renumbered(loop, rows) for loop in loops]
    is_used = _odometry_deviations(loops, poses, sessions, drifts) <= drift.max_deviation
    for _ in range(ROUNDS):
        if not is_used.any():
            break
        used_rows = np.flatnonzero(is_used)
        solved, is_inlier = _solve_with_gtsam(poses, [loops[i] for i in used_rows], sessions, drifts)
        inlier_rows = used_rows[is_inlier]
        loop_deviations = _deviations_at_loops(poses, solved, [loops[i] for i in inlier_rows], sessions, drifts)
        if (loop_deviations <= drift.max_deviation).all():
            moved_m = np.linalg.norm(solved[:, :3, 3] - poses[:, :3, 3], axis=1)
            moved_rms_m = float(np.sqrt(np.mean(moved_m**2)))
            inliers = np.isin(np.arange(len(loops)), inlier_rows)
            deviation = float(loop_deviations.max(initial=0))
            return OptimizedTrajectory(solved, inliers, float(moved_m.max()), moved_rms_m, deviation, drift)
        is_used[inlier_rows[loop_deviations > drift.max_deviation]] = False
    return OptimizedTrajectory(poses, np.zeros(len(loops), bool), drift=drift)


def _solve_with_gtsam(
    odometry: Float[np.ndarray, "n 4 4"],
    loops: Sequence[LoopClosure],
    sessions: Int[np.ndarray, " n"],
    drifts: Mapping[int, DriftModel],
) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " k"]]:
    """Solve a pose graph with gtsam. Returns the solved poses, and whether each loop is an inlier. `sessions` is the
    session of each pose. The motion between the last and the first pose of two sessions is unknown."""
    gtsam, graph = gtsam_library(), FactorGraph()
    for frame, pose in enumerate(odometry):
        graph.add_node(frame, pose, fixed=frame == 0)
    # Between sessions, a large value keeps the graph solvable even without loops.
    metres, radians = np.full((2, len(odometry) - 1), UNKNOWN_MOTION_SIGMA)
    for session, drift in drifts.items():
        rows = np.flatnonzero(sessions == session)
        metres[rows[:-1]], radians[rows[:-1]] = step_deviations(odometry[rows], drift)
    for frame, step in enumerate(inverse(odometry[:-1]) @ odometry[1:]):
        graph.add_step(frame, frame + 1, step, metres=metres[frame], radians=radians[frame])
    odometry_factors = graph.factors.size()  # number of the factors before those of the loops
    for loop in loops:
        graph.add_loop(loop.match, loop.query, loop.match_from_query, loop.covariance)
    options = gtsam.GncLMParams()
    options.setKnownInliers(list(range(odometry_factors)))
    solver = gtsam.GncLMOptimizer(graph.factors, graph.estimates, options)
    solver.setInlierCostThresholds(OUTLIER_COST)
    solution = solver.optimize()
    poses = np.stack([solution.atPose3(frame).matrix() for frame in range(len(odometry))])
    loop_weights = np.asarray(solver.getWeights())[odometry_factors:]  # near 0 or 1
    return poses, loop_weights > 0.5


def _odometry_deviations(
    loops: Sequence[LoopClosure],
    odometry: Float[np.ndarray, "n 4 4"],
    sessions: Int[np.ndarray, " n"],
    drifts: Mapping[int, DriftModel],
) -> Float[np.ndarray, " k"]:
    """Return the deviation of each loop from the odometry, in standard deviations. 0 for loops between two sessions."""
    path, (query, match), result = DrivenPath(odometry), frames_of(loops), np.zeros(len(loops))
    for session, drift in drifts.items():
        rows = np.flatnonzero((sessions[query] == session) & (sessions[match] == session))
        result[rows] = deviations([loops[row] for row in rows.tolist()], path, drift=drift)
    return result


def _deviations_at_loops(
    odometry: Float[np.ndarray, "n 4 4"],
    poses: Float[np.ndarray, "n 4 4"],
    loops: Sequence[LoopClosure],
    sessions: Int[np.ndarray, " n"],
    drifts: Mapping[int, DriftModel],
) -> Float[np.ndarray, " k"]:
    """Return the deviation of the solved poses from the odometry at each loop, in standard deviations. It is the
    largest one along the path between the two frames of the loop, and along the paths from each of them to the next
    earlier and later frame of any loop. `sessions` is the session of each pose."""
    frames = np.unique([frame for loop in loops for frame in (loop.match, loop.query)])
    ends = [(loop.match, loop.query) for loop in loops] + list(itertools.pairwise(frames))  # of each path
    # A solved path is written as a loop, to measure its deviation. Covariance and probability are not used.
    paths = [LoopClosure(int(b), int(a), inverse(poses[a]) @ poses[b], np.zeros((6, 6)), 1.0) for a, b in ends]
    deviation = _odometry_deviations(paths, odometry, sessions, drifts)
    between_ends, to_next_frame = deviation[: len(loops)], deviation[len(loops) :]
    largest = []
    for loop, between in zip(loops, between_ends, strict=True):
        is_end = np.isin(frames, [loop.match, loop.query])
        touches_loop = is_end[:-1] | is_end[1:]  # of each path between consecutive frames
        largest.append(max(between, *to_next_frame[touches_loop], 0.0))
    return np.array(largest)


def describe_errors(result: LoopSearchResult, optimized: OptimizedTrajectory) -> list[str]:
    """Return a line with the position errors before and after the correction for each session with true positions."""
    lines = []
    trajectories = zip(result.sessions, result.unique_names, result.split(optimized.poses), strict=True)
    for session, name, corrected in trajectories:
        positions = session.recording.positions
        if positions is None or session.odometry is None or session.frames < 3:  # fewer points define no alignment
            continue
        true = positions[: session.frames]
        before_m, after_m = (trajectory_error(poses[: session.frames], true) for poses in (session.odometry, corrected))
        lines.append(
            f"position error of {name}: {before_m:.2f} m before the correction, {after_m:.2f} m "
            f"after it (RMSE, aligned with {session.recording.pose_source})"
        )
    return lines


def trajectory_error(poses: Float[np.ndarray, "n 4 4"], positions: Float[np.ndarray, "n 3"]) -> float:
    """Root mean square distance of a trajectory from true positions, in metres, after rigid alignment."""
    estimated, true = (points - points.mean(axis=0) for points in (poses[:, :3, 3], positions))
    left, _, right = np.linalg.svd(estimated.T @ true)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return float(np.sqrt(np.square(estimated @ (left @ flip @ right) - true).sum(axis=1).mean()))
