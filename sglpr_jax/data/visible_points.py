"""Visible points of a point cloud: those that a LiDAR would measure from one position, because nothing hides them.

The test is a z-buffer over the directions of the sensor. A point hides everything behind it in its cell. Points of a
near surface are far apart as seen from the sensor, so nearer points have larger cells. The cells have sizes of 0.25,
0.5, 1, ... degrees. A point belongs to the smallest size that is not below half the angle between neighbouring points.
"""

import numpy as np
from jaxtyping import Bool, Float32, Int64

NEAREST_M = 1.0
"""Minimum distance of a point from the sensor, in metres. Nearer points belong to the vehicle or to a trail."""
CELL_DEG = 0.25
"""Edge of the smallest cells of the z-buffer, in degrees."""
LARGEST_DEG = 32.0
"""Edge of the largest cells, in degrees."""
SPACINGS = 0.5
"""Minimum edge of a cell, as a multiple of the distance between neighbouring points. With larger cells, vegetation
hides more than it does from a real sensor (docs/decisions/data.md)."""
BEHIND_M = 0.3
"""Minimum distance of a hidden point behind the nearest point of its cell, in metres."""
BEHIND_CELLS = 3.0
"""Additional distance of a hidden point, in widths of the cell. Surfaces seen at a grazing angle do not hide
themselves."""
RAY_DEG = (0.2, 0.4)
"""Azimuth and elevation between the rays of the sensor, in degrees, as those of a sensor with 64 beams."""


def visible_points(
    points: Float32[np.ndarray, "n 3"], *, spacing_m: float, reach_m: float
) -> Float32[np.ndarray, "m 3"]:
    """Return the points that a LiDAR at the origin measures: the nearest visible point of each ray.

    Arguments:
      points: Point cloud in the LiDAR frame, in metres. Points must be finite.
      spacing_m: Distance between neighbouring points on a surface, in metres.
      reach_m: Maximum distance from the sensor, in metres.

    Returns:
      Some of the points, in their order.
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
    nearest = _minima(rays, ranges)
    rows = np.flatnonzero(ranges == nearest[rays])
    rows = rows[np.lexsort((*points[rows].T, rays[rows]))]
    return np.sort(rows[np.unique(rays[rows], return_index=True)[1]])


def _minima(cells: Int64[np.ndarray, " n"], ranges: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, " c"]:
    """Minimum range in each cell, or infinity."""
    minima = np.full(cells.max(initial=0) + 1, np.inf, np.float32)
    np.minimum.at(minima, cells, ranges)
    return minima
