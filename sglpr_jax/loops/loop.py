"""A loop closure: two scans of one place, and how they lie to each other."""

import dataclasses

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.loops.transforms import inverse, moved_covariance, transform, yaw_of
from sglpr_jax.loops.upright import lidar_pose, upright_from_lidar
from sglpr_jax.loops.verification import Alignment

UNSEEN_HEIGHT_M = 0.5
UNSEEN_TILT_DEG = 2.0
"""Standard deviations of what an image from above does not show: the height, and pitch and roll."""


@dataclasses.dataclass(frozen=True, eq=False)
class Loop:
    """Two frames of one place."""

    query: int
    match: int
    """Frames, counted from 0; the match is the earlier one."""
    match_from_query: Float[np.ndarray, "4 4"]
    """The pose of the query's sensor in the frame of the match's: LiDAR frames, as the points of the scans have them,
    tilted where the sensor is. Metres."""
    covariance: Float[np.ndarray, "6 6"]
    """Of a small motion of the query in its own frame: x, y, z in metres, then about x, y, z in radians."""
    probability: float
    """That the two show one place."""
    overlap: float | None = None
    """Of the scans, where they were registered in 6 degrees of freedom."""

    @property
    def yaw(self) -> float:
        """How the query is turned in the match's frame, radians counter-clockwise."""
        return float(yaw_of(self.match_from_query))

    @property
    def information(self) -> Float[np.ndarray, "6 6"]:
        """The inverse of the covariance."""
        return np.linalg.inv(self.covariance)


def planar_loop(
    query: int,
    match: int,
    alignment: Alignment,
    *,
    probability: float,
    query_mounting: Mounting | None = None,
    match_mounting: Mounting | None = None,
) -> Loop:
    """The loop of two images: in the plane of the ground, and unsure of height, pitch and roll.

    The mountings say how the sensors were tilted whose points were turned upright for these images.
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
