"""Assigns the points of a scan to rings, one ring per laser of the sensor."""

import math

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

GAP_DEG = 0.1
"""Elevation separates the rings if no ring is wider than this angle, in degrees, and all gaps between rings are
wider."""
IN_ORDER = 0.9
"""Minimum correlation of revolution and elevation for points that are stored ring after ring."""


def ring_numbers(
    points: Float[np.ndarray, "n 3"], *, lasers: Int[np.ndarray, " n"] | None = None
) -> Int32[np.ndarray, " n"]:
    """Return the ring of every finite point, counted from 0 at the lowest elevation. Rings without points have no
    number.

    The first of these sources that separates the rings is used:

    - `lasers`: the laser numbers in files of nuScenes and NCLT, in any order. If all numbers are equal, as in simulated
      NCLT files, they are ignored.
    - Elevation, if it separates all rings, as in simulated scans and for sensors with few lasers.
    - The order of the points, if they are stored ring after ring, each counter-clockwise from straight ahead, as in
      KITTI's files. There the elevation varies within a ring by more than the distance between two rings.

    Arguments:
      points: Finite points in the LiDAR frame.
      lasers: Laser number of each point, or None.

    Raises:
      ValueError: If no source separates the rings.
    """
    if len(points) == 0:
        return np.zeros(0, np.int32)
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    told = lasers is not None and lasers.min() < lasers.max()
    groups = lasers if told else _by_elevation(elevation)
    groups = groups if groups is not None else _by_order(points, elevation)
    if groups is None:
        raise ValueError(
            "expected a scan with rings (laser numbers in its file, separate elevations, or points ring after ring "
            f"from straight ahead), found {len(points)} points without rings"
        )
    return _from_the_lowest(groups, elevation)


def keep_rings(rings: Int[np.ndarray, " n"], beams: int) -> Bool[np.ndarray, " n"]:
    """Return whether each point remains if the sensor has only `beams` lasers: every 2nd of 64 for 32, every 4th for
    16.

    The sensor is assumed to have the number of found rings, rounded up to a power of two, because some lasers may have
    no returns. A sensor with at most `beams` lasers keeps all points.

    Arguments:
      rings: Ring of each point, from `ring_numbers`.
      beams: Number of lasers.
    """
    found = int(rings.max(initial=0)) + 1
    sensor = 2 ** math.ceil(math.log2(found))
    return rings % max(sensor // beams, 1) == 0


def _by_elevation(elevation: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"] | None:
    order = np.argsort(elevation)
    rising = elevation[order]
    starts = np.flatnonzero(np.diff(rising, prepend=-np.inf) > GAP_DEG)
    ends = np.append(starts[1:], len(rising)) - 1
    if (rising[ends] - rising[starts]).max() > GAP_DEG:
        return None
    groups = np.empty(len(order), np.int64)
    groups[order] = np.repeat(np.arange(len(starts)), ends - starts + 1)
    return groups


def _by_order(points: Float[np.ndarray, "n 3"], elevation: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"] | None:
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
    turn = np.cumsum(np.diff(azimuth, prepend=0) < -np.pi)
    if turn[-1] == 0 or abs(np.corrcoef(turn, elevation)[0, 1]) < IN_ORDER:
        return None
    return turn


def _from_the_lowest(groups: Int[np.ndarray, " n"], elevation: Float[np.ndarray, " n"]) -> Int32[np.ndarray, " n"]:
    _, group, count = np.unique(groups, return_inverse=True, return_counts=True)
    mean = np.bincount(group, weights=elevation) / count
    return np.argsort(np.argsort(mean)).astype(np.int32)[group]
