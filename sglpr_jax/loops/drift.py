"""Drift model of odometry: how far a loop is from the odometry between its two frames, in standard deviations."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.loops.closure import LoopClosure, Planar, compose, frames_of, planar, planar_loops, wrap_angle
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.se3 import travelled

GRAPH_M = 100.0
"""Travelled distance at which the drift of a pose graph equals that of the model, in metres."""
STEP_M, STEP_DEG = 0.005, 0.005
"""Smallest standard deviation of an odometry step in a graph, for a sensor that stands still."""


def deviations(
    loops: Sequence[LoopClosure], path: DrivenPath, *, drift: DriftModel = DriftModel()
) -> Float[np.ndarray, " k"]:
    """Mahalanobis distance of each loop from the odometry between its gravity-aligned frames.

    The distance is `sqrt(e' S^-1 e)` with 3 degrees of freedom. e is x, y and yaw of the query by the loop minus those
    by the odometry. S is the sum of the drift along the path, the loop's covariance and the constants of the model. If
    the loop has no errors, the distance is the smallest RMS drift that explains the loop, as a multiple of the model's
    drift.

    If the deviation in height alone is larger, it is returned instead. Floors of a building look alike, so a difference
    in height must not be outweighed by a good fit in the plane. The length of the path costs no time.
    """
    poses, covariances = planar_loops(loops)
    heights = np.array([loop.match_from_query[2, 3] for loop in loops])
    variances = np.array([loop.covariance[2, 2] for loop in loops])
    errors = {"covariances": covariances, "heights": heights, "height_variances": variances}
    return planar_deviations(path, *frames_of(loops), poses, drift=drift, **errors)


def planar_deviations(
    path: DrivenPath,
    query: Int[np.ndarray, " k"],
    match: Int[np.ndarray, " k"],
    match_from_query: Planar,
    *,
    drift: DriftModel,
    covariances: Float[np.ndarray, "k 3 3"] | float = 0.0,
    heights: Float[np.ndarray, " k"] | float = 0.0,
    height_variances: Float[np.ndarray, " k"] | float = 0.0,
) -> Float[np.ndarray, " k"]:
    """Return `deviations` of poses in the plane, with the heights of the queries in the frames of the matches.

    The matches may be earlier or later than the queries. The covariances are in the frames of the queries.
    """
    start, last = path.leveled(match), path.leveled(query)
    by_loop = compose(planar(start), match_from_query)
    error = by_loop - planar(last)
    error[:, 2] = wrap_angle(error[:, 2])
    spread = planar_spread(path, query, match, drift=drift)
    turn = np.tile(np.eye(3), (len(error), 1, 1))  # from the frames of the queries to that of the odometry
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(by_loop[:, 2])
    turn[:, 1, 0] = np.sin(by_loop[:, 2])
    turn[:, 0, 1] = -turn[:, 1, 0]
    spread += turn @ np.broadcast_to(covariances, spread.shape) @ np.swapaxes(turn, 1, 2)
    in_plane = np.sqrt(np.einsum("ni,ni->n", error, np.linalg.solve(spread, error[..., None])[..., 0]))
    shifts = np.column_stack([match_from_query[:, :2], np.broadcast_to(heights, len(error))])
    apart = np.einsum("kj,kj->k", start[:, 2, :3], shifts) + start[:, 2, 3] - last[:, 2, 3]
    height_spread = np.hypot(drift.height_m, drift.height_per_metre * (path.travelled[query] - path.travelled[match]))
    return np.maximum(in_plane, np.abs(apart) / np.sqrt(height_spread**2 + height_variances))


def planar_spread(
    path: DrivenPath, query: Int[np.ndarray, " k"], match: Int[np.ndarray, " k"], *, drift: DriftModel
) -> Float[np.ndarray, "k 3 3"]:
    """Covariance of x, y, yaw of each query relative to its match by a path.

    The rates of drift along the path are independent. Their integral has the variance of a constant rate.
    """
    last, between = path.leveled(query)[:, :2, 3], path.between(match, query).turned(path.level[:2])
    length = between.length[:, None, None]
    crossed = last[:, :, None] * between.first[:, None]
    levers = length * last[:, :, None] * last[:, None] - crossed - np.swapaxes(crossed, 1, 2) + between.squares
    left = np.array([[0.0, -1], [1, 0]])
    found = np.zeros((len(last), 3, 3))
    found[:, :2, :2] = left @ levers @ left.T
    found[:, :2, 2] = found[:, 2, :2] = (between.length[:, None] * last - between.first) @ left.T
    found[:, 2, 2] = between.length
    found *= np.radians(drift.degrees_per_metre) ** 2
    share = drift.sideways**2
    directions = (1 - share) * between.directions + share * length * np.eye(2)
    found[:, :2, :2] += drift.metres_per_metre**2 * directions
    return found * length + np.diag([drift.position_m, drift.position_m, np.radians(drift.yaw_deg)]) ** 2


def step_deviations(
    odometry: Float[np.ndarray, "n 4 4"], drift: DriftModel
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Standard deviations of the steps of a pose graph, in metres and radians.

    Steps of a graph are independent: their variances add up with the distance, while those of the model grow with its
    square. Both are equal after `GRAPH_M`.
    """
    root = np.sqrt(np.diff(travelled(odometry)) * GRAPH_M)
    metres, degrees = (
        np.hypot(drift.metres_per_metre * root, STEP_M),
        np.hypot(drift.degrees_per_metre * root, STEP_DEG),
    )
    return metres, np.radians(degrees)
