"""Vineyard: rows of vines on posts."""

import numpy as np

from sglpr_jax.sim.raw_ids import OTHER_GROUND, POLE, TERRAIN, VEGETATION
from sglpr_jax.sim.sceneries.site import Site, Strip, block, grid, post, rolling, striped_ground
from sglpr_jax.sim.sceneries.ways import rows
from sglpr_jax.sim.things import Thing

APART_M = 22.0
"""Minimum distance between passes, in metres. The vehicle skips rows to keep this distance."""
FREE_M = 5.0


def vineyard(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Rows of vines 2.8 to 3.4 m apart, with a post every 4 to 6 m."""
    pitch, every, high, thick = rng.uniform((2.8, 4, 1.6, 0.35), (3.4, 6, 2.2, 0.6)).tolist()
    skip = int(np.ceil(APART_M / pitch))
    run = rng.uniform(70, 110)
    plan = rows(length_m, run_m=run, pitch_m=skip * pitch, closed=closed, back_m=6.0, corner_m=2.0)
    across = pitch * (np.arange(-2 * skip, (plan.count + 1) * skip) + 0.5)
    middles = np.arange(FREE_M, plan.run_m - FREE_M - every, every) + every / 2
    vines = grid(middles, across, lambda: _vines(rng, every, high, thick))
    ground = striped_ground(TERRAIN, [Strip(plan.line, -1.2, 1.2, OTHER_GROUND)], rolling(rng))
    return Site(plan.line, vines, ground)


def _vines(rng: np.random.Generator, every: float, high: float, thick: float) -> Thing:
    """Leaves between two posts, with random size and density, and the first post."""
    top, wide = high * rng.uniform(0.9, 1.05), thick * rng.uniform(0.8, 1.2)
    leaves = block(VEGETATION, every, wide, top - 0.6, bottom=0.6, roughness=0.2, porosity=rng.uniform(0.3, 0.6))
    return leaves, post(POLE, 0.1, high + 0.15, -every / 2)
