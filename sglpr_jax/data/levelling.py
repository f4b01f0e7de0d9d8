"""Transforms between the LiDAR frame and its gravity-aligned frame, for one mounting or one at each frame."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.warning import warn
from sglpr_jax.growing import GrowingArray
from sglpr_jax.se3 import inverse


def upright_from_lidar(mounting: Mounting | None) -> Float[np.ndarray, "4 4"]:
    """Transform of `Mounting.level`, from the LiDAR frame to the gravity-aligned frame. None gives the identity."""
    found = np.eye(4)
    if mounting is not None:
        found[:3, :3] = mounting.upright_from_lidar
        found[2, 3] = mounting.height_m - MODEL_HEIGHT_M
    return found


class Mountings:
    """Mounting of each frame, in order. While all frames have one mounting, it is stored once."""

    def __init__(self, mountings: Iterable[Mounting | None] = ()):
        self._each: list[Mounting | None] = []
        self._count = 0
        self._uprights = GrowingArray(np.empty((0, 4, 4)))
        self._tilted = False
        for mounting in mountings:
            self.append(mounting)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, frame: int) -> Mounting | None:
        return self._each[frame if self.differ else 0]

    @property
    def differ(self) -> bool:
        """Whether the frames have different mountings."""
        return len(self._uprights) > 0

    @property
    def tilted(self) -> bool:
        """Whether the sensor's z axis does not point up at some frame."""
        return self._tilted

    @property
    def nbytes(self) -> int:
        """Number of bytes of the transforms."""
        return self._uprights.nbytes

    def append(self, mounting: Mounting | None) -> None:
        """Add the mounting of the next frame."""
        if not self.differ and self._each and mounting != self._each[0]:
            self._each *= self._count
            self._uprights.extend(np.tile(upright_from_lidar(self._each[0]), (self._count, 1, 1)))
        if self.differ or not self._each:
            self._each.append(mounting)
        if self.differ:
            self._uprights.append(upright_from_lidar(mounting))
        self._tilted |= is_tilted(mounting)
        self._count += 1

    def uprights(self, frames: Int[np.ndarray, " k"] | int) -> Float[np.ndarray, "*k 4 4"]:
        """Transform from the LiDAR frame to the gravity-aligned frame at some frames: one each, or one for all."""
        if self.differ:
            return self._uprights.rows[frames]
        return upright_from_lidar(self._each[0] if self._each else None)


AnyMounting = Mounting | Mountings | None
"""Mounting of all frames, or that of each frame. None means gravity-aligned, 1.73 m above the ground."""


def mountings_of(recording: Recording) -> AnyMounting:
    """Mounting of a recording, or that of each scan if the sensor tilts."""
    return recording.mounting if recording.mountings is None else Mountings(recording.mountings)


def uprights(mounting: AnyMounting, frames: Int[np.ndarray, " k"] | int) -> Float[np.ndarray, "*k 4 4"]:
    """Transform from the LiDAR frame to the gravity-aligned frame at some frames: one each, or one for all."""
    return mounting.uprights(frames) if isinstance(mounting, Mountings) else upright_from_lidar(mounting)


def is_tilted(mounting: AnyMounting) -> bool:
    """Whether the z axis of a sensor does not point up, at any frame."""
    if isinstance(mounting, Mountings):
        return mounting.tilted
    return mounting is not None and tuple(mounting.up) != (0.0, 0.0, 1.0)


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
