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
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.se3 import adjoint, inverse, transform_covariance, yaw_of

ROUNDS = 20
"""Maximum number of Gauss-Newton steps."""
SMALL = 1e-9
"""Step in metres and radians at which the estimate is final."""


class TrajectorySegment(NamedTuple):
    """Frames of a session whose poses are known in one frame: all of them if there is odometry."""

    session: int
    first: int
    last: int
    """First and last row of the part."""
    is_odometry: bool
    """Whether the frame is that of the odometry. Otherwise it is the LiDAR's frame at the first row."""


class SegmentAlignment(NamedTuple):
    """Transform between a part of one session and a part of a later one."""

    match: TrajectorySegment
    query: TrajectorySegment
    match_from_query: Float[np.ndarray, "4 4"]
    """Pose of the query's frame in the match's frame, in metres."""
    covariance: Float[np.ndarray, "6 6"]
    """Covariance of a small motion of the query's frame in itself: x, y, z in metres, then rotations in radians."""
    loops: int
    """Number of loops from which the transform was estimated."""

    def in_metres(self, scale: Scale) -> "SegmentAlignment":
        """The transform before all lengths were multiplied by `scale`."""
        pose = scaled_poses(self.match_from_query, 1 / scale)
        return self._replace(match_from_query=pose, covariance=covariance_in_metres(self.covariance, scale))

    def __str__(self) -> str:
        (x, y, z), sigma = self.match_from_query[:3, 3], np.sqrt(np.diag(self.covariance))
        yaw, parts = np.degrees(yaw_of(self.match_from_query)), ""
        if not self.match.is_odometry:
            parts = f" of scans {self.match.first}-{self.match.last} and {self.query.first}-{self.query.last}"
        return (
            f"transform{parts} x {x:.2f}, y {y:.2f}, z {z:.2f} m, yaw {yaw:.2f} degrees "
            f"(+- {np.hypot(*sigma[:2]):.2f} m, {np.degrees(sigma[5]):.2f} degrees)"
        )


def aligned_frames(
    loops: Sequence[LoopClosure],
    match_poses: Float[np.ndarray, "n 4 4"],
    query_poses: Float[np.ndarray, "m 4 4"],
    *,
    match_way: Float[np.ndarray, " n"],
    query_way: Float[np.ndarray, " m"],
    drift: DriftModel,
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]]:
    """Estimate a transform and its covariance by iteratively reweighted least squares, with Cauchy's cost.

    The weight of a loop follows from its covariance and from the drift between it and the middle of all loops. Loops
    closer than `INDEPENDENT_M` see the same walls, so their weights are reduced in proportion to their distance. The
    covariance also contains the drift over the path between the loops, which does not average out.

    Matches are rows of `match_poses`, queries rows of `query_poses`: the pose of the LiDAR at each frame of a
    recording, in its own frame. The ways are the travelled distances there, in metres. There is at least one loop.
    """
    query, match = frames_of(loops)
    measured = match_poses[match] @ np.stack([loop.match_from_query for loop in loops])
    there = query_poses[query]
    drifted = _drifted(match_way[match], query_way[query], drift)
    spread = np.stack([loop.covariance for loop in loops]) + drifted
    fresh = _fresh(query_way[query])
    jacobians = np.stack([adjoint(inverse(pose)) for pose in there])
    # The first estimate is by the loop that moves the queries nearest to where the others see them: least median.
    moved = (measured @ inverse(there))[:, None] @ there[None]
    apart_m = np.linalg.norm(moved[..., :3, 3] - measured[None, :, :3, 3], axis=2)
    found = (measured @ inverse(there))[int(np.median(apart_m, axis=1).argmin())]
    for _ in range(ROUNDS):
        error = logarithm(inverse(measured) @ found @ there)
        weighted = np.linalg.solve(spread, np.concatenate([error[..., None], jacobians], axis=2))
        distance = np.einsum("ni,ni->n", error, weighted[..., 0])
        weights = fresh / (1 + distance / 6)
        gradient = np.einsum("n,nij,ni->j", weights, jacobians, weighted[..., 0])
        hessian = np.einsum("n,nij,nik->jk", weights, jacobians, weighted[..., 1:])
        step = -np.linalg.solve(hessian, gradient)
        small = np.eye(4)
        small[:3, :3], small[:3, 3] = Rotation.from_rotvec(step[3:]).as_matrix(), step[:3]
        found = found @ small
        if np.abs(step).max() < SMALL:
            break
    middle = np.eye(4)
    middle[:3, 3] = np.median(there[:, :3, 3], axis=0)
    common = transform_covariance(drifted.mean(axis=0), middle)  # drift does not average out
    return found, np.linalg.inv(hessian) + common


def _drifted(
    match_way: Float[np.ndarray, " k"], query_way: Float[np.ndarray, " k"], drift: DriftModel
) -> Float[np.ndarray, "k 6 6"]:
    """Covariance of the drift of both recordings between each loop and the middle of the loops."""
    length = np.hypot(match_way - np.median(match_way), query_way - np.median(query_way))
    position, turn = drift.metres_per_metre * length, np.radians(drift.degrees_per_metre * length)
    level = np.zeros_like(length)  # loops measure height, roll and pitch less precisely than they drift
    sigmas = np.stack([position, position, level, level, level, turn], axis=1)
    return sigmas[:, None] ** 2 * np.eye(6)


def _fresh(way: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """Weight of each loop: its share of the travelled distance, in units of `INDEPENDENT_M`, at most 1."""
    order = np.argsort(way)
    gaps = np.diff(way[order])
    around = (np.append(gaps, gaps[-1:]) + np.append(gaps[:1], gaps)) / 2 if len(gaps) else np.array([np.inf])
    weights = np.empty(len(way))
    weights[order] = np.clip(around / INDEPENDENT_M, 1e-3, 1)
    return weights


def logarithm(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 6"]:
    """Translation and rotation vector of small motions."""
    return np.concatenate([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()], axis=1)
