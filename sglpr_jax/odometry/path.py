"""A path with the integrals that drift needs, so that the drift between two frames takes constant time."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.data.mounting import Mounting, is_tilted, upright_from_lidar
from sglpr_jax.growing import GrowingArray
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.se3 import inverse

UPPER = np.triu_indices(3)
"""Rows and columns of the stored half of a symmetric matrix."""
WHOLE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Number of the stored element at each place of the matrix."""
SUMS = 1 + 3 + 6 + 6
"""Number of integrals of a frame: length, position, and the upper halves of two matrices."""


class PathIntegrals(NamedTuple):
    """Integrals over the path from one frame to another, in metres and products of metres."""

    length: Float[np.ndarray, " k"]
    first: Float[np.ndarray, "k d"]
    """Integral of the position."""
    directions: Float[np.ndarray, "k d d"]
    """Integral of the outer product of the direction of travel with itself."""
    squares: Float[np.ndarray, "k d d"]
    """Integral of the outer product of the position with itself."""

    def turned(self, rotation: Float[np.ndarray, "d 3"]) -> "PathIntegrals":
        """The integrals in rotated coordinates, or in some of them."""
        twice = (rotation @ part @ rotation.T for part in (self.directions, self.squares))
        return PathIntegrals(self.length, self.first @ rotation.T, *twice)


class DrivenPath:
    """Gravity-aligned poses of the sensor in one fixed frame. Adding a pose takes constant time."""

    def __init__(
        self,
        poses: Float[np.ndarray, "n 4 4"] | None = None,
        guessed_m: Float[np.ndarray, " n"] | None = None,
        *,
        tilted: bool = False,
    ):
        """Start with some poses, as in `extend`."""
        self.tilted = tilted
        """Whether the sensor is tilted. If not, the z axis of the fixed frame counts as up."""
        self._poses = GrowingArray(np.empty((0, 4, 4)))
        self._sums = GrowingArray(np.empty((0, SUMS)))
        self._guessed_m = 0.0
        self._up = np.zeros(3)
        if poses is not None:
            self.extend(poses, guessed_m)

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """Pose of each frame."""
        return self._poses.rows

    @property
    def travelled(self) -> Float[np.ndarray, " n"]:
        """Travelled distance at each frame, in metres."""
        return self._sums.rows[:, 0]

    @property
    def nbytes(self) -> int:
        """Number of bytes that the arrays hold."""
        return self._poses.nbytes + self._sums.nbytes

    @property
    def level(self) -> Float[np.ndarray, "3 3"]:
        """Rotation from the fixed frame to one whose z axis points up.

        Odometry often starts with the identity, so its world is tilted like the sensor. Up is the average over all
        poses.
        """
        if not self.tilted or not len(self):
            return np.eye(3)
        up = tuple((self._up / np.linalg.norm(self._up)).tolist())
        return upright_from_lidar(Mounting(0.0, up))[:3, :3]

    def extend(self, poses: Float[np.ndarray, "n 4 4"], guessed_m: Float[np.ndarray, " n"] | None = None) -> None:
        """Add the poses of the next frames, and the guessed motion up to each of them (`BevOdometry.guessed_m`).

        Guessed motion drifts like a path of unknown direction.
        """
        guessed_m = np.full(len(poses), self._guessed_m) if guessed_m is None else guessed_m
        if len(self):
            known, guesses = np.concatenate([self.poses[-1:], poses]), np.append(self._guessed_m, guessed_m)
            steps = _integrals(known[:, :3, 3] - self.poses[0, :3, 3], guesses)
            self._sums.extend(self._sums.rows[-1] + steps.cumsum(0))
        elif len(poses):
            steps = _integrals(poses[:, :3, 3] - poses[0, :3, 3], guessed_m)
            self._sums.extend(np.concatenate([np.zeros((1, SUMS)), steps.cumsum(0)]))
        self._poses.extend(poses)
        self._up += poses[:, :3, 2].sum(axis=0)
        self._guessed_m = float(guessed_m[-1]) if len(poses) else self._guessed_m

    def leveled(self, frames: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k 4 4"]:
        """Poses of some frames in a level world, with positions counted from that of the first frame."""
        poses = self.poses[frames]
        if len(self):
            poses[:, :3, 3] -= self.poses[0, :3, 3]
        poses[:, :3] = self.level @ poses[:, :3]
        return poses

    def between(self, start: Int[np.ndarray, " k"], end: Int[np.ndarray, " k"]) -> PathIntegrals:
        """Integrals from frames `start` to frames `end`. Positions count from that of the first frame."""
        length, first, directions, squares = np.split(self._sums.rows[end] - self._sums.rows[start], [1, 4, 10], axis=1)
        return PathIntegrals(length[:, 0], first, directions[:, WHOLE], squares[:, WHOLE])

    def position_deviations(
        self, rows: Int[np.ndarray, " k"], frame: int, *, drift: DriftModel = DriftModel()
    ) -> Float[np.ndarray, " k"]:
        """Standard deviation of the positions of some frames relative to a frame, in metres, over all directions."""
        here, sums = self.poses[frame, :3, 3] - self.poses[0, :3, 3], self._sums.rows[rows] - self._sums.rows[frame]
        weights = np.zeros(SUMS)  # integral of the squared distance from here: |p|^2 - 2 p here + |here|^2
        weights[0], weights[1:4], weights[10 + WHOLE.diagonal()] = here @ here, -2 * here, 1
        lever, length = np.abs(sums @ weights), np.abs(sums[:, 0])
        across = np.sqrt(1 + drift.sideways**2) * drift.metres_per_metre * length
        return np.sqrt(across**2 + np.radians(drift.degrees_per_metre) ** 2 * length * lever)


def level_odometry(
    odometry: Float[np.ndarray, "n 4 4"], upright_from_lidar: Float[np.ndarray, "n 4 4"]
) -> Float[np.ndarray, "n 4 4"]:
    """Gravity-aligned poses of the sensor in a level world, from poses of the LiDAR."""
    path = DrivenPath(odometry @ inverse(upright_from_lidar), tilted=is_tilted(upright_from_lidar))
    poses = path.poses.copy()
    poses[:, :3] = path.level @ poses[:, :3]
    return poses


def _integrals(positions: Float[np.ndarray, "n 3"], guessed_m: Float[np.ndarray, " n"]) -> Float[np.ndarray, "m s"]:
    """Integrals over each step of a path, one step fewer than positions. s is `SUMS`."""
    steps, middle, more = np.diff(positions, axis=0), (positions[:-1] + positions[1:]) / 2, np.diff(guessed_m)
    moved = np.linalg.norm(steps, axis=1)
    length = moved + more
    square = steps[:, :, None] * steps[:, None]
    directions = square / np.maximum(moved, 1e-12)[:, None, None] + more[:, None, None] * np.diag([1.0, 1.0, 0.0])
    squares = length[:, None, None] * (middle[:, :, None] * middle[:, None] + square / 12)
    halves = (part[:, *UPPER] for part in (directions, squares))
    return np.concatenate([length[:, None], length[:, None] * middle, *halves], axis=1)
