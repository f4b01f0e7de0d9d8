"""Gravity-aligned frames: poses of the LiDAR are levelled on entry, and moved back where they are handed out."""

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.warning import warn
from sglpr_jax.se3 import inverse

LEAST_WAY_M = 20.0
"""Minimum path length for the check of poses, in metres."""
STEEPEST = 0.7
"""Maximum share of a vehicle's path that goes up or down: the sine of 45 degrees."""


def upright_from_lidar(mounting: Mounting | None) -> Float[np.ndarray, "4 4"]:
    """Transform of `Mounting.level`, from the LiDAR frame to the gravity-aligned frame. None gives the identity."""
    found = np.eye(4)
    if mounting is not None:
        found[:3, :3] = mounting.upright_from_lidar
        found[2, 3] = mounting.height_m - MODEL_HEIGHT_M
    return found


def uprights(recording: Recording) -> Float[np.ndarray, "n 4 4"]:
    """Transform from the LiDAR frame to the gravity-aligned frame at each scan."""
    each = [recording.mounting] if recording.mountings is None else recording.mountings
    return np.broadcast_to([upright_from_lidar(one) for one in each], (len(recording), 4, 4))


def is_tilted(upright_from_lidar: Float[np.ndarray, "*n 4 4"]) -> bool:
    """Whether the z axis of a sensor does not point up, at any scan."""
    return bool((upright_from_lidar[..., 2, :3] != [0.0, 0.0, 1.0]).any())


def check_level(poses: Float[np.ndarray, "n 4 4"], recording: Recording) -> None:
    """Warn if the path goes mostly up or down. Such poses are probably in camera axes, with z forward."""
    steps = (inverse(poses[:-1]) @ poses[1:])[:, :3, 3]
    way = float(np.linalg.norm(steps, axis=1).sum())
    climbed = float(np.abs((steps * uprights(recording)[:-1, 2, :3]).sum(axis=1)).sum())
    if way > LEAST_WAY_M and climbed > STEEPEST * way:
        warn(
            f"{recording.name}: expected poses of a LiDAR that moves along the ground (x forward, y left, z up), found "
            f"{climbed:.0f} of {way:.0f} m of path up or down; are they in camera axes (kitti)?"
        )
