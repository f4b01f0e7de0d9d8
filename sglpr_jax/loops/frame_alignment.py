"""Transform between the frames of two sessions, estimated from the loops between them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.loops.closure import LoopClosure, covariance_in_metres, frames_of
from sglpr_jax.loops.config import INDEPENDENT_M
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.se3 import adjoint, inverse, transform_covariance, yaw_of

ROUNDS = 20
"""Maximum number of Gauss-Newton steps."""
SMALL = 1e-9
"""Length of a step, in metres and radians, below which the iteration ends."""


class TrajectorySegment(NamedTuple):
    """Consecutive scans of a session whose poses are known in one frame. With odometry, these are all scans."""

    session: int
    first: int
    last: int
    """Numbers of the first and the last scan of the segment (`Recording.numbers`)."""
    is_odometry: bool
    """Whether the frame is that of the odometry. Otherwise it is the LiDAR's frame at the first scan."""


class SegmentAlignment(NamedTuple):
    """Transform between a segment of one session and a segment of a later one."""

    match: TrajectorySegment
    query: TrajectorySegment
    match_from_query: Float[np.ndarray, "4 4"]
    """Pose of the query's frame in the match's frame, in metres."""
    covariance: Float[np.ndarray, "6 6"]
    """Covariance of a small motion of the query's frame in itself: x, y, z in metres, then rotations in radians."""
    loops: int
    """Number of loops from which the transform was estimated."""

    def in_metres(self, scale: Scale) -> "SegmentAlignment":
        """Convert a transform with lengths multiplied by `scale` to metres."""
        pose = scaled_poses(self.match_from_query, 1 / scale)
        return self._replace(match_from_query=pose, covariance=covariance_in_metres(self.covariance, scale))

    def __str__(self) -> str:
        (x, y, z), sigma = self.match_from_query[:3, 3], np.sqrt(np.diag(self.covariance))
        yaw, scans = np.degrees(yaw_of(self.match_from_query)), ""
        if not (self.match.is_odometry and self.query.is_odometry):
            scans = f" of scans {self.match.first}-{self.match.last} and {self.query.first}-{self.query.last}"
        return (
            f"transform{scans} x {x:.2f}, y {y:.2f}, z {z:.2f} m, yaw {yaw:.2f} degrees "
            f"(+- {np.hypot(*sigma[:2]):.2f} m, {np.degrees(sigma[5]):.2f} degrees)"
        )


def align_frames(
    loops: Sequence[LoopClosure],
    match_poses: Float[np.ndarray, "n 4 4"],
    query_poses: Float[np.ndarray, "m 4 4"],
    *,
    match_travelled_m: Float[np.ndarray, " n"],
    query_travelled_m: Float[np.ndarray, " m"],
    drift: DriftModel,
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]]:
    """Estimate the transform between the frames of two recordings from the loops between them.

    The method is iteratively reweighted least squares with Cauchy's cost. The weight of a loop follows from its
    covariance and from the drift between it and the median loop. Loops closer than `INDEPENDENT_M` see the same walls,
    so their weights are reduced in proportion to their distance.

    Arguments:
      loops: At least one loop closure between the two recordings.
      match_poses: Pose of the LiDAR at each frame of the matches' recording, in its own frame.
      query_poses: The same for the queries' recording.
      match_travelled_m: Travelled distance at each frame of the matches' recording, in metres.
      query_travelled_m: The same for the queries' recording.
      drift: Drift of both recordings.

    Returns:
      match_from_query between the frames of the recordings, and its covariance. The covariance contains the drift over
      the path between the loops, which does not average out.
    """
    query, match = frames_of(loops)
    measured = match_poses[match] @ np.stack([loop.match_from_query for loop in loops])  # queries in the match frame
    queries = query_poses[query]
    drift_covariances = _drift_covariances(match_travelled_m[match], query_travelled_m[query], drift)
    covariances = np.stack([loop.covariance for loop in loops]) + drift_covariances
    independent = _independent_shares(query_travelled_m[query])
    jacobians = np.stack([adjoint(inverse(pose)) for pose in queries])
    # Start with the transform of the loop that predicts the positions of the queries of all loops best, in the median.
    transforms = measured @ inverse(queries)
    predicted = transforms[:, None] @ queries[None]
    apart_m = np.linalg.norm(predicted[..., :3, 3] - measured[None, :, :3, 3], axis=2)
    estimate = transforms[int(np.median(apart_m, axis=1).argmin())]
    for _ in range(ROUNDS):
        error = logarithm(inverse(measured) @ estimate @ queries)
        solved = np.linalg.solve(covariances, np.concatenate([error[..., None], jacobians], axis=2))
        squared_distance = np.einsum("ni,ni->n", error, solved[..., 0])
        weights = independent / (1 + squared_distance / 6)
        gradient = np.einsum("n,nij,ni->j", weights, jacobians, solved[..., 0])
        hessian = np.einsum("n,nij,nik->jk", weights, jacobians, solved[..., 1:])
        step = -np.linalg.solve(hessian, gradient)
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix()
        motion[:3, 3] = step[:3]
        estimate = estimate @ motion
        if np.abs(step).max() < SMALL:
            break
    median_query = np.eye(4)  # the drift counts from there
    median_query[:3, 3] = np.median(queries[:, :3, 3], axis=0)
    return estimate, np.linalg.inv(hessian) + transform_covariance(drift_covariances.mean(axis=0), median_query)


def _drift_covariances(
    match_travelled_m: Float[np.ndarray, " k"], query_travelled_m: Float[np.ndarray, " k"], drift: DriftModel
) -> Float[np.ndarray, "k 6 6"]:
    """Covariance of the drift of both recordings between each loop and the median loop.

    The arguments are travelled distances at the matches and queries of the loops, in metres.
    """
    match_lengths_m = match_travelled_m - np.median(match_travelled_m)
    query_lengths_m = query_travelled_m - np.median(query_travelled_m)
    length_m = np.hypot(match_lengths_m, query_lengths_m)
    position, yaw = drift.metres_per_metre * length_m, np.radians(drift.degrees_per_metre * length_m)
    zero = np.zeros_like(length_m)  # of height, roll and pitch, whose drift is less than the errors of loops
    sigmas = np.stack([position, position, zero, zero, zero, yaw], axis=1)
    return sigmas[:, None] ** 2 * np.eye(6)


def _independent_shares(travelled_m: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """Weight of each loop: mean distance to the loops before and after it, divided by `INDEPENDENT_M`, at most 1."""
    if len(travelled_m) == 1:
        return np.ones(1)
    order = np.argsort(travelled_m)
    gaps_m = np.diff(travelled_m[order])
    gaps_before_m, gaps_after_m = np.append(gaps_m[:1], gaps_m), np.append(gaps_m, gaps_m[-1:])
    weights = np.empty(len(travelled_m))
    weights[order] = np.clip((gaps_after_m + gaps_before_m) / 2 / INDEPENDENT_M, 1e-3, 1)
    return weights


def logarithm(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 6"]:
    """Translation (metres) and rotation vector (radians) of small motions, given as poses."""
    return np.concatenate([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()], axis=1)
