"""Car park of equal storeys above one another, joined by ramps."""

import numpy as np

from sglpr_jax.sim.levels import Levels
from sglpr_jax.sim.raw_ids import BUILDING, PARKING
from sglpr_jax.sim.sceneries.enclosed import wall
from sglpr_jax.sim.sceneries.site import Site, Spot, block, even_ground, grid, jittered
from sglpr_jax.sim.sceneries.ways import rounded
from sglpr_jax.sim.things import Thing
from sglpr_jax.sim.vehicles import car

WIDE_M = 17.5
"""Distance between the two aisles along x, in metres."""
HALF_M = 8.8
"""Distance from an aisle along x to the wall behind its cars, in metres."""
RAMP_M = 12.0
"""Distance from the upper aisle to the ramp, in metres."""
TURN_M = 5.0
"""Space for turning at the ends of aisles and ramps, in metres."""
LONGER = 2.0
"""Maximum length of the path, as a multiple of the length asked for."""
PITCH_M = 45.0
"""Distance between two storeys in the world that holds them side by side, in metres."""


def storeys(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Three to six storeys with the same walls and pillars, and with different cars.

    The path laps each storey once on its way up. A closed path laps the lowest storey twice. The length of the path is
    between `length_m` and LONGER times this length if this gives three to six storeys.
    """
    run, rise, stall, full = rng.uniform((34, 3.0, 2.5, 0.7), (44, 3.6, 2.7, 0.9)).tolist()
    lap_m = 2 * (run + WIDE_M + RAMP_M)
    fewest, most = (int(np.clip(np.ceil(far / lap_m), 3, 6)) for far in (length_m, LONGER * length_m))
    count, height = int(rng.integers(fewest, most + 1)), rise - 0.3
    xs = np.arange(TURN_M, run - TURN_M, stall)
    shell, pillar = _shell(run, height), (block(BUILDING, 0.4, 0.6, height),)
    spots = []
    for k in range(count):
        y = k * PITCH_M
        aisles = np.array([y, y + WIDE_M])
        cars = [
            *grid(xs, aisles + 5.8, lambda: car(rng), heading=np.pi / 2),
            *grid(xs, aisles - 5.8, lambda: car(rng), heading=-np.pi / 2),
        ]
        pillars = grid(xs[::3] - stall / 2, np.concatenate([aisles - 4.2, aisles + 4.2]), lambda: pillar)
        spots += [*jittered(rng, cars, 0.12, keep=full), *pillars, Spot(shell, 0.0, y)]
    lap = [(0.0, WIDE_M), (0.0, 0.0), (run, 0.0), (run, WIDE_M)]
    ramp = [(run, WIDE_M + RAMP_M), (0.0, WIDE_M + RAMP_M)]
    corners = [*lap * closed, *(lap + ramp) * count]
    line = rounded(np.array(corners[: -len(ramp)]), corner_m=1.5)
    levels = Levels(rise, PITCH_M, WIDE_M + HALF_M, TURN_M, run - TURN_M)
    return Site(line, spots, even_ground(PARKING), levels, returns=closed)


def _shell(run: float, height: float) -> Thing:
    """Ceiling, outer walls, and the wall between a storey and its ramp, which is open at both ends."""
    left, right, low, inner, high = -TURN_M, run + TURN_M, -HALF_M, WIDE_M + HALF_M, WIDE_M + RAMP_M + 3.0
    corners = [(left, low), (right, low), (right, high), (left, high)]
    walls = [wall(corners[i - 1], corners[i], height) for i in range(4)]
    walls.append(wall((TURN_M, inner), (run - TURN_M, inner), height))
    x, y = (left + right) / 2, (low + high) / 2
    return *walls, block(BUILDING, right - left, high - low, 0.3, x, y, bottom=height, roughness=0.02)
