"""Parking garage: equal floors with pillars and parked cars, joined by ramps."""

import numpy as np

from sglpr_jax.sim.raw_ids import BUILDING, PARKING
from sglpr_jax.sim.sceneries.enclosed import wall
from sglpr_jax.sim.sceneries.site import Site, Spot, block, even_ground, grid, jittered
from sglpr_jax.sim.sceneries.ways import rows
from sglpr_jax.sim.things import Thing
from sglpr_jax.sim.vehicles import car

PITCH_M = 11.5
"""Distance from the aisle of a floor to the next ramp, and from a ramp to the aisle of the next floor, in metres."""
HALF_M = 8.8
"""Distance from the aisle of a floor to the walls along the floor, in metres."""
TURN_M = 5.0
"""Space for turning at the ends of floors and ramps, in metres."""


def garage(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Floors side by side, each followed by a ramp. Rows 0, 2, 4, ... are floors, and the other rows are ramps.

    The ground has one height at each position, so floors above each other are not possible. Walls hide each floor from
    the others.
    """
    run, height, full = rng.uniform(30, 40), rng.uniform(2.4, 3.0), rng.uniform(0.75, 0.92)
    plan = rows(length_m, run_m=run, pitch_m=PITCH_M, closed=closed, back_m=9.0, corner_m=1.5)
    aisles, stall = PITCH_M * np.arange(0, plan.count, 2), rng.uniform(2.5, 2.7)
    xs = np.arange(TURN_M, plan.run_m - TURN_M, stall)
    cars = [
        *grid(xs, aisles + 5.8, lambda: car(rng), heading=np.pi / 2),
        *grid(xs, aisles - 5.8, lambda: car(rng), heading=-np.pi / 2),
    ]
    pillar = (block(BUILDING, 0.4, 0.6, height),)
    pillars = grid(xs[::3] - stall / 2, np.concatenate([aisles - 4.2, aisles + 4.2]), lambda: pillar)
    shell = Spot(_shell(plan.count, plan.run_m, height, closed), 0.0, 0.0)
    return Site(plan.line, [*jittered(rng, cars, 0.12, keep=full), *pillars, shell], even_ground(PARKING))


def _shell(count: int, run_m: float, height: float, closed: bool) -> Thing:
    """Ceiling, outer walls, and a wall between each two rows. The wall is open at the end where the path passes."""
    low, high = -HALF_M, (count - 1) * PITCH_M + HALF_M
    left, right = -TURN_M, run_m + TURN_M
    walls = []
    for k in range(count - 1):
        y = (k + k % 2) * PITCH_M + (HALF_M if k % 2 == 0 else -HALF_M)
        first, last = ((left, run_m - TURN_M), (TURN_M, right))[k % 2]
        walls.append(wall((first, y), (last, y), height))
    if closed:  # a ramp from the last row to the first
        walls.append(wall((left, 4.0), (left, (count - 1) * PITCH_M - 4.0), height))
        left -= 8.0
    corners = [(left, low), (right, low), (right, high), (left, high)]
    walls += [wall(corners[i - 1], corners[i], height) for i in range(4)]
    ceiling = block(
        BUILDING, right - left, high - low, 0.3, (left + right) / 2, (low + high) / 2, bottom=height, roughness=0.02
    )
    return *walls, ceiling
