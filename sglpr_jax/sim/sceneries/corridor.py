"""Corridor with doors at equal distances on both sides."""

import numpy as np
from jaxtyping import Float

from sglpr_jax.sim.raw_ids import BUILDING, OTHER_GROUND
from sglpr_jax.sim.sceneries.site import Site, Spot, block, even_ground
from sglpr_jax.sim.sceneries.ways import STEP_M, Line, rounded
from sglpr_jax.sim.things import Thing

Place = Float[np.ndarray, "2"]
DOOR_M = 1.0
BEYOND_M = 40.0
"""Length of the corridor before the first and after the last scan, in metres."""
THICK_M = 0.6


def corridor(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """One straight corridor, or four corridors at right angles around a core, with a door every 5 to 7 m."""
    half, height, pitch, recess = rng.uniform(1.0, 1.4), rng.uniform(2.4, 3.0), rng.uniform(5, 7), rng.uniform(0.1, 0.3)
    line, corners = _around(rng, length_m) if closed else _straight(length_m)
    starts = corners if closed else corners[:1]
    spots = []
    for start, stop in zip(starts, np.roll(corners, -1, axis=0), strict=False):
        spots += _walls(start, stop, half, height, pitch, recess, closed)
    low, high = corners.min(axis=0), corners.max(axis=0)
    (long, wide), (x, y) = (high - low + 4).tolist(), ((low + high) / 2).tolist()
    ceiling = Spot((block(BUILDING, long, wide, 0.3, bottom=height),), x, y)
    return Site(line, [*spots, ceiling], even_ground(OTHER_GROUND))


def _straight(length_m: float) -> tuple[Line, Line]:
    """Straight path, and the ends of its corridor."""
    x = np.arange(0, length_m, STEP_M)
    return np.stack([x, np.zeros(len(x))], axis=1), np.array([(-BEYOND_M, 0.0), (length_m + BEYOND_M, 0.0)])


def _around(rng: np.random.Generator, length_m: float) -> tuple[Line, Line]:
    """Closed path around a rectangular core, and the corners of its corridors."""
    long = (0.5 + rng.uniform(0, 0.15)) * length_m / 2
    wide = length_m / 2 - long
    corners = np.array([(0.0, 0.0), (long, 0.0), (long, wide), (0.0, wide)])
    return rounded(corners, corner_m=0.5, closed=True), corners


def _walls(
    start: Place, stop: Place, half: float, height: float, pitch: float, recess: float, closed: bool
) -> list[Spot]:
    """Walls along one straight corridor. If `closed`, the left wall belongs to the core and is shorter."""
    length, ahead = float(np.linalg.norm(stop - start)), (stop - start) / np.linalg.norm(stop - start)
    heading = float(np.arctan2(ahead[1], ahead[0]))
    spots = []
    for side in (1, -1):
        first = (half if side > 0 else -half) if closed else 0.0
        pieces = max(1, round((length - 2 * first) / pitch))
        each = (length - 2 * first) / pieces
        thing = _piece(each, half, height, recess, side)
        for k in range(pieces):
            x, y = (start + (first + k * each) * ahead).tolist()
            spots.append(Spot(thing, x, y, heading))
    return spots


def _piece(each: float, half: float, height: float, recess: float, side: int) -> Thing:
    """Piece of wall of length `each`, with a door in its middle."""
    away, part = half + THICK_M / 2, (each - DOOR_M) / 2
    return (
        block(BUILDING, part, THICK_M, height, part / 2, side * away),
        block(BUILDING, DOOR_M, THICK_M, height, each / 2, side * (away + recess)),
        block(BUILDING, part, THICK_M, height, each - part / 2, side * away),
    )
