"""Open car park: rows of parked cars along parallel aisles."""

import numpy as np

from sglpr_jax.sim.raw_ids import PARKING, POLE
from sglpr_jax.sim.sceneries.site import Site, even_ground, grid, jittered, post
from sglpr_jax.sim.sceneries.ways import rows
from sglpr_jax.sim.vehicles import parked

FREE_M = 6.0
"""Free length at both ends of an aisle, in metres."""
MORE = 2
"""Number of aisles before the first and after the last driven aisle."""


def car_park(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Equal aisles, 22 to 28 m apart, with parked cars on both sides and lamps between the aisles."""
    pitch, stall, full = rng.uniform(22, 28), rng.uniform(2.5, 2.8), rng.uniform(0.8, 0.92)
    plan = rows(length_m, run_m=rng.uniform(60, 100), pitch_m=pitch, closed=closed, back_m=7.0, corner_m=2.5)
    aisles = pitch * np.arange(-MORE, plan.count + MORE)
    stalls, away = np.arange(FREE_M, plan.run_m - FREE_M, stall), rng.uniform(5.8, 6.5)
    left = grid(stalls, aisles + away, lambda: parked(rng), heading=np.pi / 2)
    right = grid(stalls, aisles - away, lambda: parked(rng), heading=-np.pi / 2)
    lamp = (post(POLE, 0.25, 7.0),)
    lamps = grid(np.arange(FREE_M, plan.run_m, rng.uniform(20, 30)), aisles + pitch / 2, lambda: lamp)
    return Site(plan.line, [*jittered(rng, left + right, 0.15, keep=full), *lamps], even_ground(PARKING))
