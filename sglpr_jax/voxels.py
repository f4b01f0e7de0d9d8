"""Voxels of a point cloud: their numbers, one point for each, and a cloud that grows."""

import numpy as np
from jaxtyping import Float, Int64

_ROW = 1 << 21
"""Number of voxels in a row. Coordinates beyond begin a row again."""
ABOVE = _ROW**2
"""Difference between the number of a voxel and that of the voxel below it."""


def voxel_numbers(points: Float[np.ndarray, "n 3"], edge_m: float) -> Int64[np.ndarray, " n"]:
    """Return the number of the voxel of each point, for voxels with an edge of `edge_m` metres."""
    x, y, z = (np.floor(points.T.astype(np.float64) / edge_m).astype(np.int64) + _ROW // 2) % _ROW
    return z * ABOVE + y * _ROW + x


def one_per_voxel(points: Float[np.ndarray, "n 3"], edge_m: float) -> Float[np.ndarray, "m 3"]:
    """Return the first point of each voxel, in their order."""
    _, first_rows = np.unique(voxel_numbers(points, edge_m), return_index=True)
    return points[np.sort(first_rows)]


class VoxelCloud:
    """Cloud with one point per voxel, the first, of points that are added in parts."""

    def __init__(self, edge_m: float):
        self._edge_m = edge_m
        self._merged = np.zeros((0, 3), np.float32)
        self._pending: list[Float[np.ndarray, "_ 3"]] = []
        """Points that were added since, one per voxel of their part."""

    def __len__(self) -> int:
        """Return the number of points without those of the last parts, which may be as many again."""
        return len(self._merged)

    def add(self, points: Float[np.ndarray, "n 3"]) -> None:
        """Add points, in metres. They are stored as float32."""
        self._pending.append(one_per_voxel(points.astype(np.float32), self._edge_m))
        if sum(map(len, self._pending)) > len(self._merged):  # not for each part: this sorts all points
            self._merge()

    @property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """All points."""
        self._merge()
        return self._merged

    def _merge(self) -> None:
        if not self._pending:
            return
        self._merged = one_per_voxel(np.concatenate([self._merged, *self._pending]), self._edge_m)
        self._pending = []
