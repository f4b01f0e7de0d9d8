"""Warehouse: equal aisles between shelves with pallets."""

import numpy as np

from sglpr_jax.sim.raw_ids import BUILDING, OTHER_GROUND, OTHER_OBJECT, POLE
from sglpr_jax.sim.sceneries.site import Site, Spot, block, even_ground, grid
from sglpr_jax.sim.sceneries.ways import rows
from sglpr_jax.sim.things import Thing

FREE_M = 2.5
"""Free length at both ends of an aisle, in metres."""
MORE = 1
"""Number of aisles before the first and after the last driven aisle."""
LEVEL_M = 1.7


def warehouse(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Aisles 5 to 6 m apart, between shelves with three levels that are 85 to 95 % full."""
    pitch, aisle, bay, full = rng.uniform(5, 6), rng.uniform(2.6, 3.0), rng.uniform(2.4, 3.0), rng.uniform(0.85, 0.95)
    plan = rows(length_m, run_m=rng.uniform(25, 40), pitch_m=pitch, closed=closed, back_m=2.5, corner_m=0.6)
    lanes = pitch * np.arange(-MORE, plan.count + MORE + 1)
    bays = np.arange(FREE_M, plan.run_m - FREE_M - bay, bay) + bay / 2
    spots = grid(bays, lanes - pitch / 2, lambda: _bay(rng, bay, pitch - aisle, full))
    low, high, height = lanes[0] - pitch / 2, lanes[-1] - pitch / 2, rng.uniform(6, 9)
    x, y, long, wide = plan.run_m / 2, (low + high) / 2, plan.run_m + 14.0, high - low + 6.0
    walls = [block(BUILDING, long, 0.4, height, y=side * wide / 2) for side in (-1, 1)]
    walls += [block(BUILDING, 0.4, wide, height, x=side * long / 2) for side in (-1, 1)]
    ceiling = block(BUILDING, long, wide, 0.4, bottom=height)
    return Site(plan.line, [*spots, Spot((*walls, ceiling), x, y)], even_ground(OTHER_GROUND))


def _bay(rng: np.random.Generator, bay: float, deep: float, full: float) -> Thing:
    """One bay of a double shelf: a frame, two boards, and pallets on three levels on both sides."""
    parts = [block(POLE, 0.12, 0.12, 3.4 * LEVEL_M, -bay / 2, side * (deep / 2 - 0.06)) for side in (-1, 1)]
    parts += [block(OTHER_OBJECT, bay, deep, 0.14, bottom=level * LEVEL_M) for level in (1, 2)]
    for level in range(3):
        for side in (-1, 1):
            wide, thick, high = rng.uniform((0.75 * bay, 0.38 * deep, 0.8), (0.92 * bay, 0.46 * deep, 1.45)).tolist()
            if rng.random() < full:
                y = side * (deep / 2 - thick / 2 - rng.uniform(0, 0.1))
                parts.append(block(OTHER_OBJECT, wide, thick, high, y=y, bottom=level * LEVEL_M + 0.14))
    return tuple(parts)
