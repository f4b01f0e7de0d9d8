"""Correction of a trajectory by its loops: a pose graph, solved with gtsam (extra `gtsam`).

In least squares, every wrong loop bends the graph. Graduated non-convexity (Yang et al., RA-L 2020) starts with a
convex cost and ends with one that ignores outliers. The result is compared with the stated drift of the odometry.
"""

import dataclasses
import importlib
import itertools
from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.data.levelling import AnyMounting, mountings_of, upright_from_lidar, upright_odometry, uprights
from sglpr_jax.data.warning import warn
from sglpr_jax.loops.closure import Loop, frames_of
from sglpr_jax.loops.drift import deviations, step_deviations
from sglpr_jax.loops.search import FoundLoops
from sglpr_jax.loops.search_between import FoundRecordings
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.se3 import inverse, moved_covariance

FIRST_POSE = 1e-6
"""Standard deviation of the first pose, which stays fixed, in metres and radians."""
MOST_RISEN_M = 2.0
"""Maximum correction of a height without a warning, in metres."""
UNCONNECTED = 1e2
"""Standard deviation of the motion between two recordings, in metres and radians."""
ROUNDS = 5
"""Maximum number of solutions. Before each next one, loops that bend the solution beyond the drift are dropped."""


class OptimizedTrajectory(NamedTuple):
    """A corrected trajectory, and its distance from the odometry."""

    poses: Float[np.ndarray, "n 4 4"]
    """Pose of the LiDAR at each searched frame, in the frame of the odometry. The first pose is not changed."""
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


def optimize_trajectory(found: FoundLoops) -> OptimizedTrajectory:
    """Correct the odometry of a recording by its loops, within the stated drift. Warns if heights move by metres.

    It takes about a second for a few hundred frames, and minutes for a few thousand.

    Arguments:
      found: Loops found with odometry.

    Raises:
      ValueError: If the loops were found without odometry.
      ImportError: If the extra `gtsam` is not installed.

    Example:
      found = find_loops(recording, params, odometry=odometry)
      corrected = optimize_trajectory(found).poses
    """
    if found.odometry is None:
        raise ValueError(f"{found.recording.name}: expected loops found with odometry, found loops without it")
    odometry = found.odometry[: found.frames]
    corrected = optimized(odometry, found.loops, drift=found.drift, mounting=mountings_of(found.recording))
    risen_m = float(np.abs(corrected.poses[:, 2, 3] - odometry[:, 2, 3]).max(initial=0))
    if risen_m > MOST_RISEN_M:
        warn(
            f"{found.recording.name}: expected heights near those of the odometry, found them moved by up to "
            f"{risen_m:.1f} m; only registered loops measure heights"
        )
    return corrected


def optimized(
    odometry: Float[np.ndarray, "n 4 4"],
    loops: tuple[Loop, ...],
    *,
    drift: DriftModel = DriftModel(),
    mounting: AnyMounting = None,
    starts: Sequence[int] = (0,),
) -> OptimizedTrajectory:
    """Solve the graph of odometry and loops.

    Loops that contradict the odometry are dropped. If the solution contradicts the odometry between the frames of a
    loop, that loop is dropped, too, and the graph is solved again. If a contradiction remains after `ROUNDS` solutions,
    the odometry is returned without inliers.

    Arguments:
      odometry: Pose of the LiDAR at each frame.
      loops: Loops between these frames.
      drift: Stated drift of the odometry.
      mounting: Mounting of the LiDAR, or that at each frame.
      starts: First frame of each recording, if the frames are those of several recordings. Between two recordings there
        is no odometry, and loops between them cannot contradict it.

    Raises:
      ImportError: If the extra `gtsam` is not installed.
    """
    gtsam, rules = gtsam_library(), {"drift": drift, "mounting": mounting, "starts": starts}
    used = _contradictions(loops, odometry, **rules) <= drift.max_deviation
    for _ in range(ROUNDS):
        if not used.any():
            break
        chosen = np.flatnonzero(used)
        poses, fits = _solved(gtsam, odometry, [loops[i] for i in chosen], drift, starts)
        members = chosen[fits]
        bend = _bend(odometry, poses, [loops[i] for i in members], **rules)
        if (bend <= drift.max_deviation).all():
            moved = np.linalg.norm(poses[:, :3, 3] - odometry[:, :3, 3], axis=1)
            rms, deviation = float(np.sqrt(np.mean(moved**2))), float(bend.max(initial=0))
            inliers = np.isin(np.arange(len(loops)), members)
            return OptimizedTrajectory(poses, inliers, float(moved.max()), rms, deviation, drift)
        used[members[bend > drift.max_deviation]] = False
    return OptimizedTrajectory(odometry.copy(), np.zeros(len(loops), bool), drift=drift)


def _solved(
    gtsam: ModuleType,
    odometry: Float[np.ndarray, "n 4 4"],
    loops: Sequence[Loop],
    drift: DriftModel,
    starts: Sequence[int],
) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " k"]]:
    """The poses of the solution, and whether each loop is an inlier of it."""
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for frame, pose in enumerate(odometry):
        start.insert(frame, gtsam.Pose3(pose))
    first = gtsam.noiseModel.Isotropic.Sigma(6, FIRST_POSE)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(odometry[0]), first))
    sigmas = np.repeat(np.stack(step_deviations(odometry, drift)[::-1], axis=1), 3, axis=1)
    for begin in starts[1:]:  # keeps the graph solvable without loops between recordings
        sigmas[max(begin - 1, 0) : begin] = UNCONNECTED
    for frame, pose in enumerate(inverse(odometry[:-1]) @ odometry[1:]):
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas[frame])
        graph.add(gtsam.BetweenFactorPose3(frame, frame + 1, gtsam.Pose3(pose), noise))
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


def _contradictions(
    loops: Sequence[Loop],
    odometry: Float[np.ndarray, "n 4 4"],
    *,
    drift: DriftModel,
    mounting: AnyMounting,
    starts: Sequence[int],
) -> Float[np.ndarray, " k"]:
    """Deviation of each loop from the odometry (`deviations`). It is 0 for loops between two recordings."""
    found = deviations(loops, odometry, drift=drift, mounting=mounting)
    recording = [np.searchsorted(starts, frames, side="right") for frames in frames_of(loops)]
    return np.where(recording[0] == recording[1], found, 0.0)


def _bend(
    odometry: Float[np.ndarray, "n 4 4"], poses: Float[np.ndarray, "n 4 4"], loops: Sequence[Loop], **rules: Any
) -> Float[np.ndarray, " k"]:
    """Deviation of the solved poses from the odometry at each loop, in standard deviations.

    Deviations are measured along the path between the two frames of the loop, and along the paths from each of them to
    the next earlier and later frame of any loop. The largest one counts.
    """
    frames = np.unique([frame for loop in loops for frame in (loop.match, loop.query)])
    ends = [(loop.match, loop.query) for loop in loops] + list(itertools.pairwise(frames))
    solved = [Loop(int(b), int(a), inverse(poses[a]) @ poses[b], np.zeros((6, 6)), 1.0) for a, b in ends]
    found = _contradictions(solved, odometry, **rules)
    return np.array(
        [max(found[k], *(found[len(loops) :][_touching(frames, loop)]), 0.0) for k, loop in enumerate(loops)]
    )


def _touching(frames: np.ndarray, loop: Loop) -> Bool[np.ndarray, " m"]:
    """Whether each path between consecutive `frames` starts or ends at a frame of the loop."""
    ends = np.isin(frames, [loop.match, loop.query])
    return ends[:-1] | ends[1:]


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


class OptimizedRecordings(NamedTuple):
    """Corrected trajectories of several recordings."""

    poses: tuple[Float[np.ndarray, "_ 4 4"], ...]
    """Pose of the LiDAR at each searched frame of each recording, in the frame of its group's first recording."""
    groups: tuple[tuple[int, ...], ...]
    """Numbers of the recordings that loops connect, each group in order. Groups have different frames."""
    corrections: tuple[OptimizedTrajectory, ...]
    """Correction of each group. Its poses are those of gravity-aligned frames."""


def placements(found: FoundRecordings) -> tuple[tuple[int, Float[np.ndarray, "4 4"]], ...]:
    """Return the group of each recording, and the transform from its odometry frame to that of the group's first one.

    Groups are named by the number of their first recording. Transforms with more loops are used first. Recordings
    without odometry, or without a common place, are groups of their own.
    """
    placed: dict[int, tuple[int, np.ndarray]] = {}
    links = [(len(one.loops), one) for one in found.between if one.aligned and one.aligned[0].match.is_odometry]
    links.sort(key=lambda link: -link[0])
    for root in range(len(found.recordings)):
        placed.setdefault(root, (root, np.eye(4)))
        grown = True
        while grown:
            grown = False
            for _, one in links:
                match_from_query = one.aligned[0].alignment.match_from_query
                for known, new, known_from_new in (
                    (one.match, one.query, match_from_query),
                    (one.query, one.match, inverse(match_from_query)),
                ):
                    if known in placed and new not in placed:
                        group, first_from_known = placed[known]
                        placed[new] = group, first_from_known @ known_from_new
                        grown = True
                if grown:
                    break
    return tuple(placed[number] for number in range(len(found.recordings)))


def optimize_recordings(found: FoundRecordings) -> OptimizedRecordings:
    """Correct the odometry of all recordings by all loops. Recordings that loops connect get one frame.

    Arguments:
      found: Loops found with odometry.

    Raises:
      ValueError: If the loops were found without odometry.
      ImportError: If the extra `gtsam` is not installed.
    """
    without = next((one.recording.name for one in found.recordings if one.odometry is None), None)
    if without is not None:
        raise ValueError(f"{without}: expected loops found with odometry, found loops without it")
    placed = placements(found)
    poses: dict[int, np.ndarray] = {}
    groups, corrections = [], []
    for group in dict.fromkeys(group for group, _ in placed):
        members = tuple(number for number, (other, _) in enumerate(placed) if other == group)
        corrected, parts = _optimized_group(found, members, [placed[number][1] for number in members])
        poses |= dict(zip(members, parts, strict=True))
        groups.append(members)
        corrections.append(corrected)
    return OptimizedRecordings(tuple(poses[number] for number in sorted(poses)), tuple(groups), tuple(corrections))


def _optimized_group(
    found: FoundRecordings, members: Sequence[int], first_from_members: Sequence[Float[np.ndarray, "4 4"]]
) -> tuple[OptimizedTrajectory, list[Float[np.ndarray, "_ 4 4"]]]:
    """Correct the recordings of a group together, in gravity-aligned frames, because their mountings may differ."""
    some = [found.recordings[number] for number in members]
    mountings = [mountings_of(one.recording) for one in some]
    odometry = [one.odometry[: one.frames] for one in some if one.odometry is not None]
    level = np.eye(4)
    if len(odometry[0]):
        first = odometry[0][0] @ inverse(uprights(mountings[0], 0))
        level = upright_odometry(odometry[0], mountings[0])[0] @ inverse(first)
    upright = [
        level @ to_first @ poses @ inverse(uprights(mounting, np.arange(len(poses))))
        for to_first, poses, mounting in zip(first_from_members, odometry, mountings, strict=True)
    ]
    starts = np.cumsum([0, *(len(poses) for poses in upright)])[:-1].tolist()
    start_of = dict(zip(members, starts, strict=True))
    loops = _joined_loops(found, start_of)
    corrected = optimized(np.concatenate(upright), tuple(loops), drift=some[0].drift, starts=starts)
    parts = [
        inverse(level) @ poses @ uprights(mounting, np.arange(len(poses)))
        for poses, mounting in zip(np.split(corrected.poses, starts[1:]), mountings, strict=True)
    ]
    return corrected, parts


def _joined_loops(found: FoundRecordings, start_of: dict[int, int]) -> list[Loop]:
    """Loops within and between the recordings of a group, in gravity-aligned frames and joined rows."""
    of = [(number, number, found.recordings[number].loops) for number in start_of]
    of += [(one.match, one.query, one.loops) for one in found.between if {one.match, one.query} <= set(start_of)]
    joined = []
    for match, query, loops in of:
        ours_of, theirs_of = (found.recordings[number].recording.mounting_of for number in (query, match))
        for loop in loops:
            ours, theirs = ours_of(loop.query), theirs_of(loop.match)
            pose = upright_from_lidar(theirs) @ loop.match_from_query @ inverse(upright_from_lidar(ours))
            covariance = moved_covariance(loop.covariance, upright_from_lidar(ours))
            values = {"query": loop.query + start_of[query], "match": loop.match + start_of[match]}
            joined.append(dataclasses.replace(loop, **values, match_from_query=pose, covariance=covariance))
    return joined
