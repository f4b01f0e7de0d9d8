"""Equal rooms along a corridor, with the same or with different furniture."""

import numpy as np

from sglpr_jax.sim.raw_ids import BUILDING, OTHER_GROUND, OTHER_OBJECT
from sglpr_jax.sim.sceneries.site import Site, Spot, block, even_ground, grid
from sglpr_jax.sim.sceneries.ways import STEP_M, Line, rounded
from sglpr_jax.sim.things import Thing

HALF_M = 1.0
"""Half width of the corridor, in metres. Rooms begin THICK_M farther out."""
THICK_M = 0.2
DOOR_M = 1.4
SIDE_M = 0.25
"""Distance from the middle of a door to the paths into the room and out of it, in metres."""
MORE = 2
"""Number of rooms before the first and after the last visited room."""


def rooms_equal(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Rooms with the same furniture."""
    return _rooms(rng, length_m, closed, equal=True)


def rooms(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Rooms with different furniture."""
    return _rooms(rng, length_m, closed, equal=False)


def _rooms(rng: np.random.Generator, length_m: float, closed: bool, *, equal: bool) -> Site:
    pitch, size, deep, height = rng.uniform(7.5, 8.5), *rng.uniform(4.7, 5.3, 2), rng.uniform(2.4, 3.0)
    each = pitch + 2 * (HALF_M + 0.6 * deep) + (pitch if closed else 0.0)  # a closed path returns through the corridor
    count = max(2, round(length_m / each) if closed else int(np.ceil(length_m / each)))
    line = _tour(count, pitch, HALF_M + 0.6 * deep, closed)
    line = line if closed else line[: round(length_m / STEP_M)]
    middles = pitch * np.arange(-MORE, count + MORE)
    same = _furniture(rng, size, deep)
    inside = grid(middles, (HALF_M + THICK_M,), lambda: same if equal else _furniture(rng, size, deep))
    shell = grid(middles, (0.0,), lambda: _shell(pitch, size, deep, height))
    middle, length = float(middles.mean()), pitch * len(middles)
    ends = tuple(block(BUILDING, 0.3, 2 * HALF_M, height, x) for x in (-length / 2, length / 2))
    wall = block(BUILDING, length, 0.3, height, y=-HALF_M - 0.15)
    ceiling = block(BUILDING, length, 2 * HALF_M + 2 * deep + 2, 0.3, bottom=height)
    return Site(line, [*inside, *shell, Spot((*ends, wall, ceiling), middle, 0.0)], even_ground(OTHER_GROUND))


def _tour(count: int, pitch: float, deep: float, closed: bool) -> Line:
    """Path into and out of one room after another. A closed path returns on the other side of the corridor."""
    visit = np.array([(-SIDE_M, 0.0), (-SIDE_M, deep), (SIDE_M, deep), (SIDE_M, 0.0)])
    corners = [visit + np.array([k * pitch, 0.0]) for k in range(count)]
    start = [[(-pitch / 2, 0.0)]]
    back = [[(corners[-1][-1, 0] + 1.0, 0.0), (corners[-1][-1, 0] + 1.0, -0.4), (-pitch / 2, -0.4)]] if closed else []
    return rounded(np.concatenate([*start, *corners, *back]), corner_m=0.15, closed=closed)


def _shell(pitch: float, size: float, deep: float, height: float) -> Thing:
    """Walls of a room with its door at x = 0, and the block between it and the next room."""
    front, between, jamb = HALF_M + THICK_M / 2, pitch - size, (size - DOOR_M) / 2
    outer = (DOOR_M + jamb) / 2
    return (
        *(block(BUILDING, jamb, THICK_M, height, x, front) for x in (-outer, outer)),
        block(BUILDING, between, deep + THICK_M, height, pitch / 2, HALF_M + (deep + THICK_M) / 2),
        block(BUILDING, pitch, 0.3, height, y=HALF_M + THICK_M + deep + 0.15),
    )


def _furniture(rng: np.random.Generator, size: float, deep: float) -> Thing:
    """Cupboards, desks and shelves along the walls of a room: two on each side and two at the back."""
    parts = []
    for low in (0.1, 0.5):
        for side in (-1, 1):
            wide, thick, high = rng.uniform((0.5, 0.35, 0.6), (1.8, 0.8, 2.1)).tolist()
            y = low * deep + wide / 2 + rng.uniform(0, 0.1) * deep
            parts.append(block(OTHER_OBJECT, thick, wide, high, side * (size - thick) / 2, y))
        wide, thick, high = rng.uniform((0.5, 0.35, 0.6), (1.6, 0.7, 2.1)).tolist()
        x = (low - 0.3) * 2 * (size / 2 - 0.9) + rng.uniform(-0.4, 0.4)
        parts.append(block(OTHER_OBJECT, wide, thick, high, x, deep - thick / 2))
    return tuple(parts)
