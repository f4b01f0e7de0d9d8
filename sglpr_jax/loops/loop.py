"""A loop closure: two scans of one place, and the pose of one relative to the other."""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.loops.transforms import inverse, moved_covariance, transform, yaw_of
from sglpr_jax.loops.upright import lidar_pose, upright_from_lidar
from sglpr_jax.loops.verification import Alignment

UNSEEN_HEIGHT_M = 0.5
UNSEEN_TILT_DEG = 2.0
"""Standard deviations of height, pitch and roll, which an image from above does not show."""

Reason = Literal[
    "repeats",
    "too few neighbours",
    "contradicts the motion",
    "contradicts the odometry",
    "contradicts other loops",
    "little overlap",
]
"""Why a pair that looked like a loop closure was rejected."""


@dataclasses.dataclass(frozen=True, eq=False)
class Loop:
    """Two frames of one place."""

    query: int
    match: int
    """Frame numbers, counted from 0. The match is the earlier frame."""
    match_from_query: Float[np.ndarray, "4 4"]
    """Pose of the query's LiDAR in the frame of the match's LiDAR, in metres. The frames are those of the points, and
    tilted if the sensor is."""
    covariance: Float[np.ndarray, "6 6"]
    """Covariance of a small motion of the query in its own frame: x, y, z in metres, then rotations about x, y, z in
    radians."""
    probability: float
    """Probability that both frames show one place."""
    overlap: float | None = None
    """Overlap of the scans, if they were registered in 6 degrees of freedom."""

    @property
    def yaw(self) -> float:
        """Rotation of the query in the match's frame, in radians counter-clockwise."""
        return float(yaw_of(self.match_from_query))

    @property
    def information(self) -> Float[np.ndarray, "6 6"]:
        """The inverse of the covariance."""
        return np.linalg.inv(self.covariance)


@dataclasses.dataclass(frozen=True, eq=False)
class Rejected:
    """A pair that looked like a loop closure, and the reason why it was rejected."""

    loop: Loop
    reason: Reason


def planar_loop(
    query: int,
    match: int,
    alignment: Alignment,
    *,
    probability: float,
    query_mounting: Mounting | None = None,
    match_mounting: Mounting | None = None,
) -> Loop:
    """Returns the loop of two aligned images, in the plane of the ground.

    Arguments:
      query: Frame of the query.
      match: Frame of the match.
      alignment: Pose of the query's image in the match's image, and its covariance.
      probability: Probability that both frames show one place.
      query_mounting: Mounting of the query's sensor, whose points were turned upright for the image.
      match_mounting: Mounting of the match's sensor.
    """
    upright = transform(float(alignment.x), float(alignment.y), float(alignment.yaw))
    covariance = np.diag([0.0, 0, UNSEEN_HEIGHT_M, *[np.radians(UNSEEN_TILT_DEG)] * 2, 0]) ** 2
    seen = np.array([0, 1, 5])
    to_query = np.eye(3)
    to_query[:2, :2] = upright[:2, :2].T  # the alignment's covariance is in the match's frame
    covariance[np.ix_(seen, seen)] = to_query @ np.asarray(alignment.covariance, np.float64) @ to_query.T
    pose = lidar_pose(upright, query=query_mounting, match=match_mounting)
    covariance = moved_covariance(covariance, inverse(upright_from_lidar(query_mounting)))
    return Loop(query, match, pose, covariance, float(probability))
