"""Between the own frame of a LiDAR and the upright one of its images: a tilted sensor does not know where up is.

Images are compared as an upright sensor would have seen them (`Mounting`); poses are handed in and out as those of the
sensor itself, whose points a user has. Without a tilt the two frames differ in height alone.
"""

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.warning import warn
from sglpr_jax.loops.transforms import inverse

LEAST_WAY_M = 20.0
"""Of shorter ways nothing is said."""
STEEPEST = 0.7
"""No vehicle goes on more steeply than that over all of its way: the sine of 45 degrees."""


def check_level(poses: Float[np.ndarray, "n 4 4"], mounting: Mounting | None, *, name: str) -> None:
    """Warn of poses by which the sensor goes up or down more than on: a camera's, whose z is forward, were read."""
    steps = (inverse(poses[:-1]) @ poses[1:])[:, :3, 3]
    way = float(np.linalg.norm(steps, axis=1).sum())
    up = (0.0, 0.0, 1.0) if mounting is None else mounting.up
    climbed = float(np.abs(steps @ np.array(up)).sum())
    if way > LEAST_WAY_M and climbed > STEEPEST * way:
        warn(
            f"{name}: expected poses of a LiDAR that goes along the ground (x forward, y left, z up), found "
            f"{climbed:.0f} of {way:.0f} m of way up or down: are they in the axes of a camera (kitti)?"
        )


def upright_from_lidar(mounting: Mounting | None) -> Float[np.ndarray, "4 4"]:
    """What `Mounting.level` does to points, as a transform; None is a sensor as models know it."""
    found = np.eye(4)
    if mounting is not None:
        found[:3, :3] = mounting.upright_from_lidar
        found[2, 3] = mounting.height_m - MODEL_HEIGHT_M
    return found


def lidar_pose(
    upright_match_from_query: Float[np.ndarray, "4 4"], *, query: Mounting | None, match: Mounting | None
) -> Float[np.ndarray, "4 4"]:
    """`match_from_query` of the sensors themselves, from that of their upright frames."""
    return inverse(upright_from_lidar(match)) @ upright_match_from_query @ upright_from_lidar(query)


def upright_poses(match_from_query: Float[np.ndarray, "*n 4 4"], mounting: Mounting | None) -> np.ndarray:
    """The way back, of two scans of one sensor: poses between the upright frames, from those of the sensor itself."""
    upright = upright_from_lidar(mounting)
    return upright @ match_from_query @ inverse(upright)


def upright_odometry(odometry: Float[np.ndarray, "n 4 4"], mounting: Mounting | None) -> Float[np.ndarray, "n 4 4"]:
    """Poses of the upright frames in a world whose z is up, from those of the sensor in any fixed frame.

    Odometry often begins with the identity, so that its world is as tilted as the sensor: up is where the sensor's own
    up points on average. Odometry of a sensor that is not tilted is returned as it is.
    """
    if mounting is None or mounting.up == (0.0, 0.0, 1.0) or not len(odometry):
        return odometry
    up = (odometry[:, :3, :3] @ np.array(mounting.up)).mean(axis=0)
    level = np.eye(4)
    level[:3, :3] = Mounting(0.0, tuple((up / np.linalg.norm(up)).tolist())).upright_from_lidar
    return level @ odometry @ inverse(upright_from_lidar(mounting))
