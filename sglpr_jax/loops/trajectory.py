"""Poses of a drive, frame by frame, with the travelled distance."""

import numpy as np
from jaxtyping import Float

from sglpr_jax.growing import GrowingArray
from sglpr_jax.loops.motion import UNKNOWN_M
from sglpr_jax.loops.transforms import travelled


class Trajectory:
    """Poses of all frames in one fixed frame, and the travelled distance at each. Adding a pose takes constant time."""

    def __init__(self):
        self._poses = GrowingArray(np.empty((0, 4, 4)))
        self._travelled = GrowingArray(np.empty(0))

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """Pose of each frame."""
        return self._poses.rows

    @property
    def travelled(self) -> Float[np.ndarray, " n"]:
        """Travelled distance at each frame, in metres."""
        return self._travelled.rows

    @property
    def nbytes(self) -> int:
        """Number of bytes that the arrays hold."""
        return self._poses.nbytes + self._travelled.nbytes

    def add(self, pose: Float[np.ndarray, "4 4"], *, continues: bool = True) -> None:
        """Add the pose of the next frame. If it is not in the fixed frame of those before, `continues` is False."""
        self._poses.append(pose)
        before = self._travelled.rows[-1] if len(self._travelled) else 0.0
        self._travelled.append(before + (travelled(self.poses[-2:])[-1] if continues else UNKNOWN_M))
