"""Path of a sensor with integrals along it, from which the drift between any two frames follows in constant time."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.data.mounting import Mounting, is_tilted, upright_from_lidar
from sglpr_jax.growing import GrowingArray
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.se3 import inverse

UPPER = np.triu_indices(3)
"""Rows and columns of the upper half of a symmetric matrix, which is stored."""
FROM_UPPER = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Index of each element of a symmetric matrix in its upper half."""
SUMS = 1 + 3 + 6 + 6
"""Number of integrals of a frame (`PathIntegrals`): length, position, and the upper halves of two matrices."""


class PathIntegrals(NamedTuple):
    """Integrals over the path from one frame to another, in metres and products of metres."""

    length: Float[np.ndarray, " k"]
    """Length of the path, in metres."""
    position: Float[np.ndarray, "k d"]
    """Integral of the position."""
    direction_products: Float[np.ndarray, "k d d"]
    """Integral of the outer product of the direction of travel with itself."""
    position_products: Float[np.ndarray, "k d d"]
    """Integral of the outer product of the position with itself."""

    def rotated(self, rotation: Float[np.ndarray, "d 3"]) -> "PathIntegrals":
        """The integrals in rotated coordinates. With two rows of a rotation, in two coordinates."""
        directions = rotation @ self.direction_products @ rotation.T
        positions = rotation @ self.position_products @ rotation.T
        return PathIntegrals(self.length, self.position @ rotation.T, directions, positions)


class DrivenPath:
    """Gravity-aligned poses of the sensor in one fixed frame, with integrals. Adding a pose takes constant time."""

    def __init__(
        self,
        poses: Float[np.ndarray, "n 4 4"] | None = None,
        guessed_m: Float[np.ndarray, " n"] | None = None,
        *,
        tilted: bool = False,
    ):
        """Start with these poses and guesses, as in `extend`."""
        self.tilted = tilted
        """Whether the sensor is tilted. If not, the z axis of the fixed frame counts as up."""
        self._poses = GrowingArray(np.empty((0, 4, 4)))
        self._sums = GrowingArray(np.empty((0, SUMS)))
        """Integrals from the first frame to each frame, relative to the position of the first one."""
        self._guessed_m = 0.0
        """Guessed motion up to the last frame, in metres."""
        self._up_sum = np.zeros(3)
        """Sum of the z axes of all poses."""
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
        """Rotation from the fixed frame to one whose z axis points up: along the average z axis of all poses.

        Odometry often starts with the identity, so its fixed frame is tilted like the sensor.
        """
        if not self.tilted or not len(self):
            return np.eye(3)
        up = tuple((self._up_sum / np.linalg.norm(self._up_sum)).tolist())
        return upright_from_lidar(Mounting(0.0, up))[:3, :3]

    def extend(self, poses: Float[np.ndarray, "n 4 4"], guessed_m: Float[np.ndarray, " n"] | None = None) -> None:
        """Add the poses of the next frames, and the guessed motion up to each of them (`BevOdometry.guessed_m`).

        Guessed motion drifts like a path of unknown direction. Without `guessed_m`, nothing is guessed.
        """
        if not len(poses):
            return
        guessed_m = np.full(len(poses), self._guessed_m) if guessed_m is None else guessed_m
        if len(self):
            origin, last_sums = self.poses[0, :3, 3], self._sums.rows[-1]
            path, path_guessed_m = np.concatenate([self.poses[-1:], poses]), np.append(self._guessed_m, guessed_m)
            self._sums.extend(last_sums + _integrals(path[:, :3, 3] - origin, path_guessed_m).cumsum(0))
        else:
            steps = _integrals(poses[:, :3, 3] - poses[0, :3, 3], guessed_m)
            self._sums.extend(np.concatenate([np.zeros((1, SUMS)), steps.cumsum(0)]))
        self._poses.extend(poses)
        self._up_sum += poses[:, :3, 2].sum(axis=0)
        self._guessed_m = float(guessed_m[-1])

    def leveled(self, frames: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k 4 4"]:
        """Poses of these frames in a level world, with positions relative to the first frame of the path."""
        poses = self.poses[frames]  # a copy
        if len(self):
            poses[:, :3, 3] -= self.poses[0, :3, 3]
        poses[:, :3] = self.level @ poses[:, :3]
        return poses

    def between(self, start: Int[np.ndarray, " k"], end: Int[np.ndarray, " k"]) -> PathIntegrals:
        """Integrals from frames `start` to frames `end`. Positions are relative to the first frame of the path."""
        sums = self._sums.rows[end] - self._sums.rows[start]
        length, position, directions, positions = np.split(sums, [1, 4, 10], axis=1)
        return PathIntegrals(length[:, 0], position, directions[:, FROM_UPPER], positions[:, FROM_UPPER])

    def position_deviations(
        self, rows: Int[np.ndarray, " k"], frame: int, *, drift: DriftModel = DriftModel()
    ) -> Float[np.ndarray, " k"]:
        """Root of the trace of the position covariance of a frame relative to each of `rows` (frames), in metres."""
        position = self.poses[frame, :3, 3] - self.poses[0, :3, 3]
        sums = self._sums.rows[rows] - self._sums.rows[frame]
        # Weights of the integral of |p - position|^2 = |position|^2 - 2 p position + |p|^2 over positions p.
        weights = np.zeros(SUMS)
        weights[0] = position @ position
        weights[1:4] = -2 * position
        weights[10 + FROM_UPPER.diagonal()] = 1
        squared_levers, length_m = np.abs(sums @ weights), np.abs(sums[:, 0])
        by_position_m = np.sqrt(1 + drift.sideways**2) * drift.metres_per_metre * length_m
        return np.sqrt(by_position_m**2 + np.radians(drift.degrees_per_metre) ** 2 * length_m * squared_levers)


def level_odometry(
    odometry: Float[np.ndarray, "n 4 4"], upright_from_lidar: Float[np.ndarray, "n 4 4"]
) -> Float[np.ndarray, "n 4 4"]:
    """Convert poses of the LiDAR to gravity-aligned poses of the sensor in a world whose z axis points up."""
    path = DrivenPath(odometry @ inverse(upright_from_lidar), tilted=is_tilted(upright_from_lidar))
    poses = path.poses.copy()
    poses[:, :3] = path.level @ poses[:, :3]
    return poses


def _integrals(positions: Float[np.ndarray, "n 3"], guessed_m: Float[np.ndarray, " n"]) -> Float[np.ndarray, "m s"]:
    """Integrals over each step of a path, `SUMS` of them. There is one step fewer than positions."""
    steps, middles = np.diff(positions, axis=0), (positions[:-1] + positions[1:]) / 2
    measured_m, guess_m = np.linalg.norm(steps, axis=1), np.diff(guessed_m)
    length_m = measured_m + guess_m
    products = steps[:, :, None] * steps[:, None]
    guessed_products = guess_m[:, None, None] * np.diag([1.0, 1.0, 0.0])  # in any horizontal direction
    directions = products / np.maximum(measured_m, 1e-12)[:, None, None] + guessed_products
    squares = length_m[:, None, None] * (middles[:, :, None] * middles[:, None] + products / 12)
    columns = [length_m[:, None], length_m[:, None] * middles, directions[:, *UPPER], squares[:, *UPPER]]
    return np.concatenate(columns, axis=1)
