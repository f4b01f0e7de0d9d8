"""Transforms between the frame of a LiDAR and its gravity-aligned frame.

Images are compared in the gravity-aligned frame (`Mounting`). Poses of the API are in the frame of the sensor, the
frame of its points. Without a tilt the two frames differ only in height.
"""

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.warning import warn
from sglpr_jax.loops.mountings import AnyMounting, upright_from_lidar, uprights
from sglpr_jax.loops.transforms import inverse

LEAST_WAY_M = 20.0
"""Minimum path length for the check of poses, in metres."""
STEEPEST = 0.7
"""Maximum share of a vehicle's path that goes up or down: the sine of 45 degrees."""


def check_level(poses: Float[np.ndarray, "n 4 4"], mounting: AnyMounting, *, name: str) -> None:
    """Warn if the path goes mostly up or down. Such poses are probably in camera axes, with z forward."""
    steps = (inverse(poses[:-1]) @ poses[1:])[:, :3, 3]
    way = float(np.linalg.norm(steps, axis=1).sum())
    up = uprights(mounting, np.arange(len(steps)))[..., 2, :3]
    climbed = float(np.abs((steps * up).sum(axis=1)).sum())
    if way > LEAST_WAY_M and climbed > STEEPEST * way:
        warn(
            f"{name}: expected poses of a LiDAR that moves along the ground (x forward, y left, z up), found "
            f"{climbed:.0f} of {way:.0f} m of path up or down; are they in camera axes (kitti)?"
        )


def lidar_pose(
    upright_match_from_query: Float[np.ndarray, "4 4"], *, query: Mounting | None, match: Mounting | None
) -> Float[np.ndarray, "4 4"]:
    """Convert `match_from_query` from the gravity-aligned frames to the frames of the sensors."""
    return inverse(upright_from_lidar(match)) @ upright_match_from_query @ upright_from_lidar(query)


def upright_poses(
    match_from_query: Float[np.ndarray, "*n 4 4"],
    mounting: AnyMounting,
    *,
    query: Int[np.ndarray, " n"] | int = 0,
    match: Int[np.ndarray, " n"] | int = 0,
) -> Float[np.ndarray, "*n 4 4"]:
    """Convert `match_from_query` from the frames of the sensor to its gravity-aligned frames.

    The frame numbers count only if the mounting differs between frames.
    """
    return uprights(mounting, match) @ match_from_query @ inverse(uprights(mounting, query))


def upright_odometry(odometry: Float[np.ndarray, "n 4 4"], mounting: AnyMounting) -> Float[np.ndarray, "n 4 4"]:
    """Convert odometry of a sensor to poses of its gravity-aligned frame in a world whose z axis points up.

    Odometry often starts with the identity, so its world is tilted like the sensor. Up is the average direction of the
    sensor's up vector in that world. Odometry of a sensor that is not tilted is returned unchanged.
    """
    upright = uprights(mounting, np.arange(len(odometry)))
    up = upright[..., 2, :3]
    if not len(odometry) or (up == [0.0, 0.0, 1.0]).all():
        return odometry
    mean = np.einsum("nij,nj->ni", odometry[:, :3, :3], np.broadcast_to(up, (len(odometry), 3))).mean(axis=0)
    level = np.eye(4)
    level[:3, :3] = Mounting(0.0, tuple((mean / np.linalg.norm(mean)).tolist())).upright_from_lidar
    return level @ odometry @ inverse(upright)
