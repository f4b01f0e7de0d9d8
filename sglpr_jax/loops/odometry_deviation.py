"""Deviation of loops from the odometry, in standard deviations of its drift (limit: `DriftModel.max_deviation`)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.loops.closure import LoopClosure, frames_of, planar_measurements
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.se3 import PlanarPose, compose_planar, planar_pose, travelled, wrap_angle

GRAPH_M = 100.0
"""Travelled distance at which the drift of a pose graph's independent steps equals that of the model, in metres."""
STEP_M, STEP_DEG = 0.005, 0.005
"""Smallest standard deviation of an odometry step in a graph, for a sensor that stands still."""


def deviations(
    loops: Sequence[LoopClosure], path: DrivenPath, *, drift: DriftModel = DriftModel()
) -> Float[np.ndarray, " k"]:
    """Mahalanobis distance of each loop from the odometry between its gravity-aligned frames.

    The distance is `sqrt(e' S^-1 e)` with 3 degrees of freedom. e is x, y and yaw of the query by the loop minus those
    by the odometry. S is the sum of the drift along the path, the loop's covariance and the constants of the model.

    If the deviation in height alone is larger, it is returned instead. Floors of a building look alike, so a good fit
    in the plane must not outweigh a difference in height.
    """
    poses, covariances = planar_measurements(loops)
    heights = np.array([loop.match_from_query[2, 3] for loop in loops])
    variances = np.array([loop.covariance[2, 2] for loop in loops])
    query, match = frames_of(loops)
    measured = {"covariances": covariances, "heights": heights, "height_variances": variances}
    return planar_deviations(path, query, match, poses, drift=drift, **measured)


def planar_deviations(
    path: DrivenPath,
    query: Int[np.ndarray, " k"],
    match: Int[np.ndarray, " k"],
    match_from_query: PlanarPose,
    *,
    drift: DriftModel,
    covariances: Float[np.ndarray, "k 3 3"] | float = 0.0,
    heights: Float[np.ndarray, " k"] | float = 0.0,
    height_variances: Float[np.ndarray, " k"] | float = 0.0,
) -> Float[np.ndarray, " k"]:
    """Deviation (see `deviations`) of planar poses of queries in the frames of their matches.

    Frames of matches may be earlier or later than those of queries. Covariances are in the frames of the queries, and
    heights of the queries, in metres, in the frames of the matches.
    """
    match_pose, query_pose = path.leveled(match), path.leveled(query)
    query_by_loop = compose_planar(planar_pose(match_pose), match_from_query)
    error = query_by_loop - planar_pose(query_pose)
    error[:, 2] = wrap_angle(error[:, 2])
    cos, sin = np.cos(query_by_loop[:, 2]), np.sin(query_by_loop[:, 2])
    world_from_query = np.tile(np.eye(3), (len(error), 1, 1))
    world_from_query[:, 0, 0] = world_from_query[:, 1, 1] = cos
    world_from_query[:, 1, 0] = sin
    world_from_query[:, 0, 1] = -sin
    covariance = planar_covariance(path, query, match, drift=drift)
    loop_covariances = np.broadcast_to(covariances, covariance.shape)
    covariance += world_from_query @ loop_covariances @ np.swapaxes(world_from_query, 1, 2)
    squared_distance = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    shifts = np.column_stack([match_from_query[:, :2], np.broadcast_to(heights, len(error))])
    height_by_loop = np.einsum("kj,kj->k", match_pose[:, 2, :3], shifts) + match_pose[:, 2, 3]
    height_drift = np.hypot(drift.height_m, drift.height_per_metre * (path.travelled[query] - path.travelled[match]))
    height_error = np.abs(height_by_loop - query_pose[:, 2, 3])
    return np.maximum(np.sqrt(squared_distance), height_error / np.sqrt(height_drift**2 + height_variances))


def planar_covariance(
    path: DrivenPath, query: Int[np.ndarray, " k"], match: Int[np.ndarray, " k"], *, drift: DriftModel
) -> Float[np.ndarray, "k 3 3"]:
    """Covariance of x, y, yaw of each query relative to its match by a path, in the level world of the path.

    The rates of drift along the path are independent. Their integral has the variance of a constant rate. A heading
    error at a position p of the path moves the end of the path by (end - p), turned by 90 degrees, times the error.
    """
    end, integrals = path.leveled(query)[:, :2, 3], path.between(match, query).rotated(path.level[:2])
    length = integrals.length[:, None, None]
    # Integral of (end - p) (end - p)' over the path, and integral of (end - p).
    crossed = end[:, :, None] * integrals.position[:, None]
    lever_products = length * end[:, :, None] * end[:, None] - crossed - np.swapaxes(crossed, 1, 2)
    lever_products += integrals.position_products
    levers = integrals.length[:, None] * end - integrals.position
    quarter_turn = np.array([[0.0, -1], [1, 0]])
    covariance = np.zeros((len(end), 3, 3))
    covariance[:, :2, :2] = quarter_turn @ lever_products @ quarter_turn.T
    covariance[:, :2, 2] = covariance[:, 2, :2] = levers @ quarter_turn.T
    covariance[:, 2, 2] = integrals.length
    covariance *= np.radians(drift.degrees_per_metre) ** 2
    across = drift.sideways**2
    directions = (1 - across) * integrals.direction_products + across * length * np.eye(2)
    covariance[:, :2, :2] += drift.metres_per_metre**2 * directions
    return covariance * length + np.diag([drift.position_m, drift.position_m, np.radians(drift.yaw_deg)]) ** 2


def step_deviations(
    odometry: Float[np.ndarray, "n 4 4"], drift: DriftModel
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Standard deviations of the steps between consecutive poses for a pose graph, in metres and in radians.

    Steps of a graph are independent: their variances add up with the distance, while those of the model grow with its
    square. Both are equal after `GRAPH_M`.
    """
    root_m = np.sqrt(np.diff(travelled(odometry)) * GRAPH_M)
    metres = np.hypot(drift.metres_per_metre * root_m, STEP_M)
    return metres, np.radians(np.hypot(drift.degrees_per_metre * root_m, STEP_DEG))
