"""The rings of a scan: which of the sensor's lasers every point comes from."""

import math

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

GAP_DEG = 0.1
"""Rings stand apart where none is wider than this in elevation and all gaps between them are."""
IN_ORDER = 0.9
"""The least correlation of turn and elevation at which points are said to lie ring after ring."""


def ring_numbers(
    points: Float[np.ndarray, "n 3"], *, lasers: Int[np.ndarray, " n"] | None = None
) -> Int32[np.ndarray, " n"]:
    """The ring of every finite point, 0 for the lowest of those found. A ring without a point has no number.

    Told by the first of these that does:

    - `lasers`, the laser's number as nuScenes' and NCLT's files have it, in any order; where all are the same, as in
      simulated files of NCLT, they tell nothing;
    - elevation, where all rings stand apart, as in a simulated scan or that of a sensor with few lasers;
    - the order of the points: ring after ring, each counter-clockwise from straight ahead, as in KITTI's files. There
      elevation does not tell: within a ring it varies by more than two rings are apart.

    Raises ValueError where none does.
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
            f"from straight ahead), found {len(points)} points without"
        )
    return _from_the_lowest(groups, elevation)


def keep_rings(rings: Int[np.ndarray, " n"], beams: int) -> Bool[np.ndarray, " n"]:
    """Whether each point is left with `beams` of the sensor's lasers: of 64 rings every 2nd for 32, every 4th for 16.

    The sensor has the next power of two of the rings found: some of 64 may have returned nothing. One that has no more
    than `beams` keeps all.
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
