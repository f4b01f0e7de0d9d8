"""A large point cloud in memory: one point per voxel, stored by tile, so that a scan touches only a few tiles."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int64, Num

from sglpr_jax.data.trails import on_trail

VOXEL_M = 0.1
"""Edge of a voxel, in metres. One point per voxel is stored."""
TILE_M = 20.0
"""Edge of a tile, in metres."""
MOST_POINTS = 1 << 26
"""Maximum number of stored points: 0.8 GB."""
SAMPLED_TILES = 9
"""Number of tiles in which the spacing is measured."""
SAMPLED_POINTS = 500
"""Maximum number of points of a tile whose spacing is measured."""
NEIGHBOURS = 4
"""Number of neighbours of a point in a regular grid of points on a surface."""
_TILES, _VOXELS = 1 << 24, 1 << 21
"""Numbers of tiles and voxels in a row, for numbering them."""


@dataclass(frozen=True, eq=False)
class TiledCloud:
    """Points of a cloud near a trajectory, sorted by tile."""

    origin: Float[np.ndarray, "3"]
    """Position in the frame of the cloud to which `points` are relative, in metres."""
    points: Float32[np.ndarray, "n 3"]
    """Points in metres, one per voxel."""
    tiles: Int64[np.ndarray, " t"]
    """Numbers of the tiles that contain points, in order."""
    starts: Int64[np.ndarray, " t+1"]
    """First point of each tile, and the number of points."""
    spacing_m: float
    """Distance between neighbouring points on a surface, in metres, at least `VOXEL_M`."""
    lowest: Float[np.ndarray, "3"]
    """Minimum coordinates of the whole cloud, in metres."""
    highest: Float[np.ndarray, "3"]
    """Maximum coordinates of the whole cloud, in metres."""
    read: int
    """Number of finite points in the whole cloud."""

    def near(self, position: Float[np.ndarray, "3"], reach_m: float) -> Float32[np.ndarray, "m 3"]:
        """Return all points within the horizontal distance `reach_m`, and some more, relative to `position`."""
        at = position - self.origin
        rows = np.flatnonzero(np.isin(self.tiles, _tiles_around(at[None, :2], reach_m)))
        parts = [self.points[self.starts[row] : self.starts[row + 1]] for row in rows]
        return np.concatenate([np.zeros((0, 3), np.float32), *parts]) - at.astype(np.float32)


def tiled_cloud(
    blocks: Iterable[Num[np.ndarray, "_ 3"]], *, positions: Float[np.ndarray, "n 3"], reach_m: float, source: Path
) -> TiledCloud:
    """Store the points of a cloud that are near a trajectory, without trails of moving objects (`on_trail`).

    Arguments:
      blocks: Points of the cloud in metres, in parts. Points that are not finite are dropped.
      positions: Positions of the trajectory, in metres.
      reach_m: Maximum horizontal distance from a position, in metres.
      source: File of the cloud, for messages.

    Raises:
      ValueError: If the cloud has no finite point, or if more than `MOST_POINTS` points remain.
    """
    origin = np.round(positions[0])
    wanted = _tiles_around(positions[:, :2] - origin[:2], reach_m)
    lowest, highest, read = np.full(3, np.inf), np.full(3, -np.inf), 0
    kept, pending = np.zeros((0, 3), np.float32), []
    for block in blocks:
        points = block[np.isfinite(block).all(axis=1)].astype(np.float64)
        read += len(points)
        lowest = np.minimum(lowest, points.min(axis=0, initial=np.inf))
        highest = np.maximum(highest, points.max(axis=0, initial=-np.inf))
        points -= origin
        near = points[np.isin(_tile(points[:, :2]), wanted)].astype(np.float32)
        pending.append(_one_per_voxel(near))
        if sum(map(len, pending)) > len(kept):
            kept, pending = _one_per_voxel(np.concatenate([kept, *pending])), []
            _check_size(len(kept), source)
    kept = _one_per_voxel(np.concatenate([kept, *pending]))
    _check_size(len(kept), source)
    kept = kept[~on_trail(kept)]
    if not read:
        raise ValueError(f"{source}: expected finite points, found none")
    tile = _tile(kept[:, :2])
    order = np.argsort(tile, kind="stable")
    tiles, starts = np.unique(tile[order], return_index=True)
    points, starts = kept[order], np.append(starts, len(kept))
    return TiledCloud(origin, points, tiles, starts, _spacing(points, starts), lowest, highest, read)


def _check_size(points: int, source: Path) -> None:
    if points > MOST_POINTS:
        raise ValueError(
            f"{source}: expected at most {MOST_POINTS} points in voxels of {VOXEL_M:g} m near the trajectory, found"
            " more; cut the cloud and its trajectory into parts, or keep one point in voxels of 0.2 m"
        )


def _tile(xy: Num[np.ndarray, "n 2"]) -> Int64[np.ndarray, " n"]:
    """Number of the tile of each point."""
    column, row = np.floor(xy / TILE_M).clip(-_TILES // 2, _TILES // 2 - 1).astype(np.int64).T
    return row * _TILES + column


def _tiles_around(xy: Float[np.ndarray, "n 2"], reach_m: float) -> Int64[np.ndarray, " t"]:
    """Numbers of the tiles that squares around some positions touch, in order."""
    steps = np.arange(-int(np.ceil(reach_m / TILE_M)), int(np.ceil(reach_m / TILE_M)) + 1) * TILE_M
    around = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2).clip(-reach_m, reach_m)
    corners = np.unique(around, axis=0)
    return np.unique(_tile((np.unique(xy, axis=0)[:, None] + corners).reshape(-1, 2)))


def _one_per_voxel(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "m 3"]:
    """Return the first point of each voxel, in order."""
    x, y, z = np.floor(points.T.astype(np.float64) / VOXEL_M).astype(np.int64) % _VOXELS
    return points[np.sort(np.unique((z * _VOXELS + y) * _VOXELS + x, return_index=True)[1])]


def _spacing(points: Float32[np.ndarray, "n 3"], starts: Int64[np.ndarray, " t"]) -> float:
    """Median distance to the fourth neighbour, in the tiles with the most points, at least `VOXEL_M`."""
    from scipy.spatial import KDTree  # imported here because the import is slow

    fullest = np.argsort(np.diff(starts))[-SAMPLED_TILES:]
    found = []
    for tile in fullest:
        inside = points[starts[tile] : starts[tile + 1]]
        some = inside[:: len(inside) // SAMPLED_POINTS + 1]
        if len(inside) > NEIGHBOURS:
            found.append(KDTree(inside).query(some, k=NEIGHBOURS + 1)[0][:, -1])
    return max(VOXEL_M, float(np.median(np.concatenate(found)))) if found else VOXEL_M
