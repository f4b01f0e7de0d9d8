"""Mounting of the sensor at each frame of a search, for sensors that tilt."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.growing import GrowingArray


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
