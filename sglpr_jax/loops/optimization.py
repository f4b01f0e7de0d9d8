"""The trajectory that odometry and loops agree on best: a pose graph, solved by gtsam (extra `gtsam`).

One wrong loop bends a graph that is solved by least squares. Graduated non-convexity (Yang et al., RA-L 2020) begins
with a convex cost, on which every loop pulls a little, and ends with one that leaves out those that do not fit.
"""

import importlib
from types import ModuleType
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.loops.find import FoundLoops
from sglpr_jax.loops.graph_files import ODOMETRY_DEG, ODOMETRY_M
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.transforms import inverse

FIRST_POSE = 1e-6
"""Standard deviation of the first pose, metres and radians: it stays where it is."""


class OptimizedTrajectory(NamedTuple):
    """A corrected trajectory, and the loops that it was corrected with."""

    poses: Float[np.ndarray, "n 4 4"]
    """Of the LiDAR at each frame that was looked at, in the frame of the odometry; the first is the odometry's."""
    believed: Bool[np.ndarray, " k"]
    """Which of the loops the solution agrees with."""


def optimize_trajectory(found: FoundLoops) -> OptimizedTrajectory:
    """Correct the odometry of a recording by its loops.

    Takes a second for some hundred frames, a minute or two for some thousand. Raises ValueError where there was no
    odometry, ImportError where the extra `gtsam` is not installed.

    Example:
      found = find_loops(recording, params, odometry=odometry)
      corrected = optimize_trajectory(found).poses
    """
    if found.odometry is None:
        raise ValueError(f"{found.recording.name}: expected loops found with odometry to correct, found none")
    return optimized(found.odometry[: found.frames], found.loops)


def optimized(odometry: Float[np.ndarray, "n 4 4"], loops: tuple[Loop, ...]) -> OptimizedTrajectory:
    """Solve the graph of odometry and loops. Raises ImportError where the extra `gtsam` is not installed."""
    gtsam = _library()
    if not loops:
        return OptimizedTrajectory(odometry.copy(), np.zeros(0, bool))
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for frame, pose in enumerate(odometry):
        start.insert(frame, gtsam.Pose3(pose))
    first = gtsam.noiseModel.Isotropic.Sigma(6, FIRST_POSE)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(odometry[0]), first))
    step = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([np.radians(ODOMETRY_DEG), ODOMETRY_M], 3))
    for frame, pose in enumerate(inverse(odometry[:-1]) @ odometry[1:]):
        graph.add(gtsam.BetweenFactorPose3(frame, frame + 1, gtsam.Pose3(pose), step))
    certain = graph.size()
    for loop in loops:
        noise = gtsam.noiseModel.Gaussian.Covariance(_rotation_first(loop.covariance))
        graph.add(gtsam.BetweenFactorPose3(loop.match, loop.query, gtsam.Pose3(loop.match_from_query), noise))
    options = gtsam.GncLMParams()
    options.setKnownInliers(list(range(certain)))
    solver = gtsam.GncLMOptimizer(graph, start, options)
    solution = solver.optimize()
    poses = np.stack([solution.atPose3(frame).matrix() for frame in range(len(odometry))])
    return OptimizedTrajectory(poses, np.asarray(solver.getWeights())[certain:] > 0.5)


def trajectory_error(poses: Float[np.ndarray, "n 4 4"], positions: Float[np.ndarray, "n 3"]) -> float:
    """Metres (RMSE) between a trajectory and true positions, after the rotation and shift that bring them nearest."""
    found, true = (each - each.mean(axis=0) for each in (poses[:, :3, 3], positions))
    left, _, right = np.linalg.svd(found.T @ true)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return float(np.sqrt(np.square(found @ (left @ flip @ right) - true).sum(axis=1).mean()))


def _rotation_first(covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """As gtsam orders it."""
    order = np.array([3, 4, 5, 0, 1, 2])
    return covariance[np.ix_(order, order)]


def check_installed() -> None:
    """Raise ImportError where the extra `gtsam` is not installed, before hours of work that end in a graph."""
    _library()


def _library() -> ModuleType:
    try:
        return importlib.import_module("gtsam")
    except ImportError as error:
        raise ImportError("optimisation of a trajectory needs gtsam: pip install 'sglpr-jax[gtsam]'") from error
