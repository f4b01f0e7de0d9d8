"""Trails of moving objects in a point cloud map: low things on ground that was seen beneath and all around them.

A map of scans shows a passing vehicle once for each scan. The ground beneath the vehicle was seen before or after it
passed. Walls, hedges and parked vehicles hide the ground behind or beneath them. Trunks and poles are higher.
"""

import numpy as np
from jaxtyping import Bool, Float32, Int64

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
    """Return whether each point belongs to the trail of a moving object.

    Arguments:
      points: Points of a map in metres, z up.
    """
    if not len(points):
        return np.zeros(0, bool)
    column, row = np.floor(points[:, :2].T / np.float32(CELL_M)).astype(np.int64)
    cells, cell = np.unique(row * _COLUMNS + column, return_inverse=True)
    around = _neighbours(cells)
    lowest = np.full(len(cells) + 1, np.inf, np.float32)  # the last one stands for missing neighbours
    np.minimum.at(lowest, cell, points[:, 2])
    ground = lowest[around].min(axis=1)
    surrounded = (lowest[around] - ground[:, None] < GROUND_M).all(axis=1)
    height = points[:, 2] - ground[cell]
    tall = np.zeros(len(cells) + 1, bool)
    tall[cell[(height > HIGHEST_M) & (height < TALL_M)]] = True
    free = surrounded & ~tall[around].any(axis=1)
    return free[cell] & (height > LOWEST_M) & (height < HIGHEST_M)


def _neighbours(cells: Int64[np.ndarray, " c"]) -> Int64[np.ndarray, "c 9"]:
    """Rows of the cells around each of the ordered `cells`. Missing ones have the row after the last."""
    wanted = cells[:, None] + np.array(_AROUND)
    rows = np.searchsorted(cells, wanted).clip(max=len(cells) - 1)
    return np.where(cells[rows] == wanted, rows, len(cells))
