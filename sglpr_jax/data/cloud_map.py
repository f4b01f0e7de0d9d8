"""Point cloud maps: trails of moving objects, visible points of a pose, and points near a trajectory.

A map of scans shows a passing vehicle once for each scan. The ground beneath the vehicle was seen before or after it
passed. Walls, hedges and parked vehicles hide the ground behind or beneath them. Trunks and poles are higher.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, Num

from sglpr_jax.voxels import VoxelCloud

CELL_M = 0.4
"""Edge of a cell of the ground, in metres."""
GROUND_M = 0.25
"""Maximum difference of the lowest points of neighbouring cells of the ground, in metres."""
LOWEST_M, HIGHEST_M = 0.3, 2.2
"""Heights above the ground between which trails are removed, in metres."""
TALL_M = 3.2
"""Objects with points between `HIGHEST_M` and this height are not removed, in metres."""
_CELLS_PER_ROW = 1 << 31
"""The cell in column c of row r has the number r * _CELLS_PER_ROW + c."""
_NEIGHBOUR_STEPS = tuple(row * _CELLS_PER_ROW + column for row in (-1, 0, 1) for column in (-1, 0, 1))
"""Differences between the number of a cell and the numbers of its neighbours, with the cell itself."""


def on_trail(points: Float32[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return whether each point of a map (in metres, z up) belongs to the trail of a moving object.

    A trail is `LOWEST_M` to `HIGHEST_M` above a cell of flat ground. Its neighbours are ground without a tall object.
    """
    if not len(points):
        return np.zeros(0, bool)
    cell_of_point, neighbours, lowest = _ground_cells(points)
    ground = lowest[neighbours].min(axis=1)
    is_ground = (lowest[neighbours] - ground[:, None] < GROUND_M).all(axis=1)
    height = points[:, 2] - ground[cell_of_point]
    is_tall = np.zeros(len(lowest), bool)
    is_tall[cell_of_point[(height > HIGHEST_M) & (height < TALL_M)]] = True
    has_trail = is_ground & ~is_tall[neighbours].any(axis=1)
    return has_trail[cell_of_point] & (height > LOWEST_M) & (height < HIGHEST_M)


def height_above_ground(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, " n"]:
    """Return the height of each point above the lowest one in its cell and the neighbouring cells, in metres, z up."""
    if not len(points):
        return np.zeros(0, np.float32)
    cell_of_point, neighbours, lowest = _ground_cells(points)
    return points[:, 2] - lowest[neighbours].min(axis=1)[cell_of_point]


def _ground_cells(
    points: Float32[np.ndarray, "n 3"],
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, "c 9"], Float32[np.ndarray, " c+1"]]:
    """Return the cell of each point, the neighbours of each cell with itself, and the lowest z in each cell.

    The last cell is an empty one, for neighbours without points. Its z is infinite.
    """
    column, row = np.floor(points[:, :2].T / np.float32(CELL_M)).astype(np.int64)
    cells, cell_of_point = np.unique(row * _CELLS_PER_ROW + column, return_inverse=True)
    neighbour_numbers = cells[:, None] + np.array(_NEIGHBOUR_STEPS)
    neighbours = np.searchsorted(cells, neighbour_numbers).clip(max=len(cells) - 1)
    is_occupied = cells[neighbours] == neighbour_numbers
    neighbours = np.where(is_occupied, neighbours, len(cells))
    lowest = np.full(len(cells) + 1, np.inf, np.float32)
    np.minimum.at(lowest, cell_of_point, points[:, 2])
    return cell_of_point, neighbours, lowest


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
    """Return the points that a sensor at the origin sees, at most one for each of its rays, in their order.

    Arguments:
      points: Points of a map around the sensor, in its frame, in metres.
      spacing_m: Distance between neighbouring points of the map on a surface, in metres.
      reach_m: Maximum distance of a returned point, in metres. The minimum is `NEAREST_M`.
    """
    ranges = np.sqrt(np.einsum("ni,ni->n", points, points))
    in_range = np.flatnonzero((ranges >= NEAREST_M) & (ranges <= reach_m))
    points, ranges = points[in_range], ranges[in_range]
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    elevation = np.degrees(np.arcsin((points[:, 2] / ranges).clip(-1, 1))) + 90
    rows = _nearest_rows(_cell_numbers(azimuth, elevation, *RAY_DEG), points, ranges)
    is_hidden = _are_hidden(azimuth[rows], elevation[rows], ranges[rows], spacing_m)
    return points[rows[~is_hidden]]


def _are_hidden(
    azimuth: Float32[np.ndarray, " n"],
    elevation: Float32[np.ndarray, " n"],
    ranges: Float32[np.ndarray, " n"],
    spacing_m: float,
) -> Bool[np.ndarray, " n"]:
    """Whether a nearer point hides each point in a z-buffer. The angles are in degrees, from 0.

    Each point hides others in cells of one size, the smallest that span `SPACINGS` times the angle to its neighbours.
    """
    least_edge_deg = np.degrees(SPACINGS * spacing_m / ranges)
    is_hidden = np.zeros(len(ranges), bool)
    edge_deg, smaller_edge_deg = CELL_DEG, 0.0
    while edge_deg <= LARGEST_DEG:
        cell = _cell_numbers(azimuth, elevation, edge_deg, edge_deg)
        is_largest = 2 * edge_deg > LARGEST_DEG
        hides = (least_edge_deg > smaller_edge_deg) & ((least_edge_deg <= edge_deg) | is_largest)
        nearest_m = _minimum_ranges(cell, np.where(hides, ranges, np.float32(np.inf)))[cell]
        is_hidden |= ranges > nearest_m + BEHIND_M + BEHIND_CELLS * np.radians(edge_deg) * nearest_m
        edge_deg, smaller_edge_deg = 2 * edge_deg, edge_deg
    return is_hidden


def _cell_numbers(
    azimuth: Float32[np.ndarray, " n"], elevation: Float32[np.ndarray, " n"], width_deg: float, height_deg: float
) -> Int64[np.ndarray, " n"]:
    """Number of the z-buffer cell in each direction. The angles are in degrees, from 0."""
    columns = int(np.ceil(360 / width_deg))
    column = (azimuth / width_deg).astype(np.int64).clip(max=columns - 1)
    return (elevation / height_deg).astype(np.int64) * columns + column


def _nearest_rows(
    rays: Int64[np.ndarray, " n"], points: Float32[np.ndarray, "n 3"], ranges: Float32[np.ndarray, " n"]
) -> Int64[np.ndarray, " m"]:
    """Row of the nearest point of each ray, in ascending order. Of equal ranges, z, then y, then x decides."""
    rows = np.flatnonzero(ranges == _minimum_ranges(rays, ranges)[rays])
    rows = rows[np.lexsort((*points[rows].T, rays[rows]))]  # by ray, because `lexsort` sorts by its last key first
    return np.sort(rows[np.unique(rays[rows], return_index=True)[1]])


def _minimum_ranges(cells: Int64[np.ndarray, " n"], ranges: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, " c"]:
    """Minimum range of the points in each cell, by cell number. Infinity for cells without points."""
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
_TILES = 1 << 24
"""Number of tiles in a row, for numbering them: more than any cloud has."""


@dataclass(frozen=True, eq=False)
class TiledCloud:
    """Points of a cloud near a trajectory, sorted by tile."""

    origin: Float[np.ndarray, "3"]
    """Position in the frame of the cloud to which `points` are relative, in metres."""
    points: Float32[np.ndarray, "n 3"]
    """Points in metres, one per voxel."""
    tiles: Int64[np.ndarray, " t"]
    """Numbers of the tiles that contain points, in ascending order."""
    starts: Int64[np.ndarray, " t+1"]
    """Row of the first point of each tile, then the number of points."""
    spacing_m: float
    """Distance between neighbouring points on a surface, in metres, at least `VOXEL_M`."""
    lowest: Float[np.ndarray, "3"]
    highest: Float[np.ndarray, "3"]
    """Minimum and maximum coordinates of the whole cloud, in metres."""
    total: int
    """Number of finite points in the whole cloud."""

    def near(self, position: Float[np.ndarray, "3"], reach_m: float) -> Float32[np.ndarray, "m 3"]:
        """Return the points, relative to `position`, of all tiles within `reach_m` metres in x and y."""
        position = position - self.origin
        near_tiles = np.flatnonzero(np.isin(self.tiles, _tiles_around(position[None, :2], reach_m)))
        clouds = [self.points[self.starts[tile] : self.starts[tile + 1]] for tile in near_tiles]
        return np.concatenate([np.zeros((0, 3), np.float32), *clouds]) - position.astype(np.float32)


def tiled_cloud(
    blocks: Iterable[Num[np.ndarray, "_ 3"]], *, positions: Float[np.ndarray, "n 3"], reach_m: float, source: Path
) -> TiledCloud:
    """Keep the points of a cloud near a trajectory, one per voxel, without trails of moving objects (`on_trail`).

    Arguments:
      blocks: Points of the cloud in metres, some at a time. Points that are not finite are dropped.
      positions: Positions of the trajectory, in metres.
      reach_m: Maximum horizontal distance from a position, in metres.
      source: File of the cloud, for messages.

    Raises ValueError if the cloud has no finite point, or if more than `MOST_POINTS` points remain.
    """
    origin = np.round(positions[0])
    near_tiles = _tiles_around(positions[:, :2] - origin[:2], reach_m)
    lowest, highest = np.full(3, np.inf), np.full(3, -np.inf)
    total = 0
    cloud = VoxelCloud(VOXEL_M)
    for block in blocks:
        points = block[np.isfinite(block).all(axis=1)].astype(np.float64)
        total += len(points)
        lowest = np.minimum(lowest, points.min(axis=0, initial=np.inf))
        highest = np.maximum(highest, points.max(axis=0, initial=-np.inf))
        points -= origin
        cloud.add(points[np.isin(_tile_numbers(points[:, :2]), near_tiles)])
        _check_size(len(cloud), source)
    stored = cloud.points
    _check_size(len(stored), source)
    stored = stored[~on_trail(stored)]
    if not total:
        raise ValueError(f"{source}: expected finite points, found none")
    tile = _tile_numbers(stored[:, :2])
    order = np.argsort(tile, kind="stable")
    points = stored[order]
    tiles, starts = np.unique(tile[order], return_index=True)
    starts = np.append(starts, len(points))
    spacing_m = _spacing_m(points, starts)
    return TiledCloud(origin, points, tiles, starts, spacing_m, lowest, highest, total)


def _check_size(points: int, source: Path) -> None:
    """Raise ValueError for more than `MOST_POINTS` points."""
    if points > MOST_POINTS:
        raise ValueError(
            f"{source}: expected at most {MOST_POINTS} points in voxels of {VOXEL_M:g} m near the trajectory, found"
            " more; cut the cloud and its trajectory into parts, or keep one point in voxels of 0.2 m"
        )


def _tile_numbers(xy: Num[np.ndarray, "n 2"]) -> Int64[np.ndarray, " n"]:
    """Number of the tile of each point, from its x and y in metres."""
    column, row = np.floor(xy / TILE_M).clip(-_TILES // 2, _TILES // 2 - 1).astype(np.int64).T
    return row * _TILES + column


def _tiles_around(xy: Float[np.ndarray, "n 2"], reach_m: float) -> Int64[np.ndarray, " t"]:
    """Numbers of all tiles within `reach_m` of a position in x and y, in ascending order."""
    reach_tiles = int(np.ceil(reach_m / TILE_M))
    steps_m = (np.arange(-reach_tiles, reach_tiles + 1) * TILE_M).clip(-reach_m, reach_m)
    offsets_m = np.stack(np.meshgrid(steps_m, steps_m), axis=-1).reshape(-1, 2)  # every tile has at least one
    return np.unique(_tile_numbers((np.unique(xy, axis=0)[:, None] + offsets_m).reshape(-1, 2)))


def _spacing_m(points: Float32[np.ndarray, "n 3"], starts: Int64[np.ndarray, " t"]) -> float:
    """Median distance of a point to its fourth neighbour in the tiles with the most points, at least `VOXEL_M`."""
    from scipy.spatial import KDTree  # imported here because the import is slow

    distances_m = []
    for tile in np.argsort(np.diff(starts))[-SAMPLED_TILES:]:
        tile_points = points[starts[tile] : starts[tile + 1]]
        sample = tile_points[:: len(tile_points) // SAMPLED_POINTS + 1]
        if len(tile_points) > NEIGHBOURS:
            distances, _ = KDTree(tile_points).query(sample, k=NEIGHBOURS + 1)  # the first is the point itself
            distances_m.append(distances[:, -1])
    return max(VOXEL_M, float(np.median(np.concatenate(distances_m)))) if distances_m else VOXEL_M
