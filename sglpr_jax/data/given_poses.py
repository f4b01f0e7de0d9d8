"""Checks of the poses that a caller gives for the scans of a recording."""

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.recording import Recording
from sglpr_jax.se3 import are_rotations


def poses_of_scans(
    recording: Recording, world_from_lidar: Float[np.ndarray, "n 4 4"], *, use: str
) -> Float[np.ndarray, "n 4 4"]:
    """Return the poses as float64.

    Arguments:
      recording: Recording of scans.
      world_from_lidar: Pose of the LiDAR at each scan.
      use: What the poses are used for, for messages.

    Raises:
      ValueError: If the recording has ready-made images, or if the poses have another length or no rotations.
    """
    if recording.has_images:
        raise ValueError(f"sequence {recording.name}: expected scans for {use}, found ready-made images")
    poses = np.asarray(world_from_lidar, np.float64)
    if poses.shape != (len(recording), 4, 4):
        raise ValueError(
            f"sequence {recording.name}: expected a pose (4, 4) for each of {len(recording)} scans, found an array of "
            f"shape {poses.shape}"
        )
    return turned_poses(poses, use=use)


def turned_poses(poses: Float[np.ndarray, "n 4 4"], *, use: str) -> Float[np.ndarray, "n 4 4"]:
    """Return the poses. Raises ValueError if one of them is not finite or has no rotation."""
    wrong = ~(np.isfinite(poses).all((-2, -1)) & are_rotations(poses[:, :3, :3]))
    if wrong.any():
        row = int(wrong.argmax())
        raise ValueError(f"{use}: expected poses with rotations, found {poses[row].tolist()} at scan {row}")
    return poses
