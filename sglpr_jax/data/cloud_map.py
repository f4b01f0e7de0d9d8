"""Point cloud maps: trails of moving objects, visible points of a pose, and points near a trajectory.

A map of scans shows a passing vehicle once for each scan. The ground beneath the vehicle was seen before or after it
passed. Walls, hedges and parked vehicles hide the ground behind or beneath them. Trunks and poles are higher.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, Num

CELL_M = 0.4
"""Edge of a cell of the ground, in metres."""
GROUND_M = 0.25
"""Maximum difference of the lowest points of neighbouring cells of the ground, in metres."""
LOWEST_M, HIGHEST_M = 0.3, 2.2
"""Heights above the ground between which trails are removed, in metres."""
TALL_M = 3.2
"""Objects with points between `HIGHEST_M` and this height are not removed, in metres."""
_COLUMNS = 1 << 31
_AROUND = tuple(row * _COLUMNS + column for row in (-1, 0, 1) for column in (-1, 0, 1))
"""Differences between the numbers of a cell and of its neighbours, with the cell itself."""


def on_trail(points: Float32[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return whether each point of a map (in metres, z up) belongs to the trail of a moving object."""
    if not len(points):
        return np.zeros(0, bool)
    column, row = np.floor(points[:, :2].T / np.float32(CELL_M)).astype(np.int64)
    cells, cell = np.unique(row * _COLUMNS + column, return_inverse=True)
    neighbours = cells[:, None] + np.array(_AROUND)
    around = np.searchsorted(cells, neighbours).clip(max=len(cells) - 1)
    around = np.where(cells[around] == neighbours, around, len(cells))  # the last row stands for missing neighbours
    lowest = np.full(len(cells) + 1, np.inf, np.float32)
    np.minimum.at(lowest, cell, points[:, 2])
    ground = lowest[around].min(axis=1)
    surrounded = (lowest[around] - ground[:, None] < GROUND_M).all(axis=1)
    height = points[:, 2] - ground[cell]
    tall = np.zeros(len(cells) + 1, bool)
    tall[cell[(height > HIGHEST_M) & (height < TALL_M)]] = True
    free = surrounded & ~tall[around].any(axis=1)
    return free[cell] & (height > LOWEST_M) & (height < HIGHEST_M)


NEAREST_M = 1.0
"""Minimum distance of a point from the sensor, in metres. Nearer points belong to the vehicle or to a trail."""
CELL_DEG, LARGEST_DEG = 0.25, 32.0
"""Edges of the smallest and of the largest cells of the z-buffer, in degrees."""
SPACINGS = 0.5
"""Minimum edge of a cell, as a multiple of the distance between neighbouring points. With larger cells, vegetation
hides more than it does from a real sensor (docs/decisions.md)."""
BEHIND_M = 0.3
"""Minimum distance of a hidden point behind the nearest point of its cell, in metres."""
BEHIND_CELLS = 3.0
"""Additional distance of a hidden point, in widths of the cell. Surfaces seen at a grazing angle do not hide
themselves."""
RAY_DEG = (0.2, 0.4)
"""Azimuth and elevation between the rays of the sensor, in degrees, as those of a sensor with 64 beams."""


def remove_hidden_points(
    points: Float32[np.ndarray, "n 3"], *, spacing_m: float, reach_m: float
) -> Float32[np.ndarray, "m 3"]:
    """Return the points that a sensor at the origin sees, in their order.

    Arguments:
      points: Points of a map around the sensor, in its frame, in metres.
      spacing_m: Distance between neighbouring points of the map on a surface, in metres.
      reach_m: Maximum distance of a point, in metres.
    """
    ranges = np.sqrt(np.einsum("ni,ni->n", points, points))
    within = np.flatnonzero((ranges >= NEAREST_M) & (ranges <= reach_m))
    points, ranges = points[within], ranges[within]
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    elevation = np.degrees(np.arcsin((points[:, 2] / ranges).clip(-1, 1))) + 90
    first = _nearest(_cell(azimuth, elevation, *RAY_DEG), points, ranges)
    hidden = _hidden(azimuth[first], elevation[first], ranges[first], spacing_m)
    return points[first[~hidden]]


def _hidden(
    azimuth: Float32[np.ndarray, " n"],
    elevation: Float32[np.ndarray, " n"],
    ranges: Float32[np.ndarray, " n"],
    spacing_m: float,
) -> Bool[np.ndarray, " n"]:
    """Whether a nearer point hides each point. The angles are in degrees, from 0."""
    needed_deg = np.degrees(SPACINGS * spacing_m / ranges)
    hidden = np.zeros(len(ranges), bool)
    edge_deg, smaller_deg = CELL_DEG, 0.0
    while edge_deg <= LARGEST_DEG:
        cell = _cell(azimuth, elevation, edge_deg, edge_deg)
        last = 2 * edge_deg > LARGEST_DEG
        hiding = (needed_deg > smaller_deg) & ((needed_deg <= edge_deg) | last)
        nearest = _minima(cell, np.where(hiding, ranges, np.float32(np.inf)))[cell]
        hidden |= ranges > nearest + BEHIND_M + BEHIND_CELLS * np.radians(edge_deg) * nearest
        edge_deg, smaller_deg = 2 * edge_deg, edge_deg
    return hidden


def _cell(
    azimuth: Float32[np.ndarray, " n"], elevation: Float32[np.ndarray, " n"], width_deg: float, height_deg: float
) -> Int64[np.ndarray, " n"]:
    """Number of the cell of each direction. The angles are in degrees, from 0."""
    columns = int(np.ceil(360 / width_deg))
    column = (azimuth / width_deg).astype(np.int64).clip(max=columns - 1)
    return (elevation / height_deg).astype(np.int64) * columns + column


def _nearest(
    rays: Int64[np.ndarray, " n"], points: Float32[np.ndarray, "n 3"], ranges: Float32[np.ndarray, " n"]
) -> Int64[np.ndarray, " m"]:
    """Row of the nearest point of each ray, in order. Coordinates decide between equal distances."""
    rows = np.flatnonzero(ranges == _minima(rays, ranges)[rays])
    rows = rows[np.lexsort((*points[rows].T, rays[rows]))]
    return np.sort(rows[np.unique(rays[rows], return_index=True)[1]])


def _minima(cells: Int64[np.ndarray, " n"], ranges: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, " c"]:
    """Minimum range in each cell, or infinity."""
    minima = np.full(cells.max(initial=0) + 1, np.inf, np.float32)
    np.minimum.at(minima, cells, ranges)
    return minima


VOXEL_M = 0.1
"""Edge of a voxel, in metres. One point per voxel is stored."""
TILE_M = 20.0
"""Edge of a tile, in metres."""
MOST_POINTS = 1 << 26
"""Maximum number of stored points: 0.8 GB."""
SAMPLED_TILES, SAMPLED_POINTS = 9, 500
"""Number of tiles in which the spacing is measured, and maximum number of points of each."""
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
    highest: Float[np.ndarray, "3"]
    """Minimum and maximum coordinates of the whole cloud, in metres."""
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

    Raises ValueError if the cloud has no finite point, or if more than `MOST_POINTS` points remain.
    """
    origin = np.round(positions[0])
    tiles_near = _tiles_around(positions[:, :2] - origin[:2], reach_m)
    lowest, highest, read = np.full(3, np.inf), np.full(3, -np.inf), 0
    stored, pending = np.zeros((0, 3), np.float32), []
    for block in blocks:
        points = block[np.isfinite(block).all(axis=1)].astype(np.float64)
        read += len(points)
        lowest = np.minimum(lowest, points.min(axis=0, initial=np.inf))
        highest = np.maximum(highest, points.max(axis=0, initial=-np.inf))
        points -= origin
        near = points[np.isin(_tile(points[:, :2]), tiles_near)].astype(np.float32)
        pending.append(_one_per_voxel(near))
        if sum(map(len, pending)) > len(stored):
            stored, pending = _combined([stored, *pending], source), []
    stored = _combined([stored, *pending], source)
    stored = stored[~on_trail(stored)]
    if not read:
        raise ValueError(f"{source}: expected finite points, found none")
    tile = _tile(stored[:, :2])
    order = np.argsort(tile, kind="stable")
    tiles, starts = np.unique(tile[order], return_index=True)
    points, starts = stored[order], np.append(starts, len(stored))
    return TiledCloud(origin, points, tiles, starts, _spacing(points, starts), lowest, highest, read)


def _combined(clouds: list[Float32[np.ndarray, "_ 3"]], source: Path) -> Float32[np.ndarray, "m 3"]:
    """One point per voxel of several clouds. Raises ValueError for more than `MOST_POINTS` points."""
    points = _one_per_voxel(np.concatenate(clouds))
    if len(points) > MOST_POINTS:
        raise ValueError(
            f"{source}: expected at most {MOST_POINTS} points in voxels of {VOXEL_M:g} m near the trajectory, found"
            " more; cut the cloud and its trajectory into parts, or keep one point in voxels of 0.2 m"
        )
    return points


def _tile(xy: Num[np.ndarray, "n 2"]) -> Int64[np.ndarray, " n"]:
    """Number of the tile of each point."""
    column, row = np.floor(xy / TILE_M).clip(-_TILES // 2, _TILES // 2 - 1).astype(np.int64).T
    return row * _TILES + column


def _tiles_around(xy: Float[np.ndarray, "n 2"], reach_m: float) -> Int64[np.ndarray, " t"]:
    """Numbers of the tiles that squares around some positions touch, in order."""
    tiles = int(np.ceil(reach_m / TILE_M))
    steps = (np.arange(-tiles, tiles + 1) * TILE_M).clip(-reach_m, reach_m)
    squares = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return np.unique(_tile((np.unique(xy, axis=0)[:, None] + squares).reshape(-1, 2)))


def _one_per_voxel(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "m 3"]:
    """Return the first point of each voxel, in order."""
    x, y, z = np.floor(points.T.astype(np.float64) / VOXEL_M).astype(np.int64) % _VOXELS
    return points[np.sort(np.unique((z * _VOXELS + y) * _VOXELS + x, return_index=True)[1])]


def _spacing(points: Float32[np.ndarray, "n 3"], starts: Int64[np.ndarray, " t"]) -> float:
    """Median distance to the fourth neighbour, in the tiles with the most points, at least `VOXEL_M`."""
    from scipy.spatial import KDTree  # imported here because the import is slow

    distances_m = []
    for tile in np.argsort(np.diff(starts))[-SAMPLED_TILES:]:
        inside = points[starts[tile] : starts[tile + 1]]
        sample = inside[:: len(inside) // SAMPLED_POINTS + 1]
        if len(inside) > NEIGHBOURS:
            distances_m.append(KDTree(inside).query(sample, k=NEIGHBOURS + 1)[0][:, -1])
    return max(VOXEL_M, float(np.median(np.concatenate(distances_m)))) if distances_m else VOXEL_M
