"""Orchard: rows of trees of one kind and age."""

import numpy as np

from sglpr_jax.sim.raw_ids import OTHER_GROUND, TERRAIN, TRUNK, VEGETATION
from sglpr_jax.sim.sceneries.site import Site, Strip, grid, jittered, post, rolling, striped_ground
from sglpr_jax.sim.sceneries.ways import rows
from sglpr_jax.sim.things import Part, Thing

APART_M = 22.0
"""Minimum distance between passes, in metres. The vehicle skips rows to keep this distance."""
FREE_M = 5.0


def orchard(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Rows of trees 5 to 6.5 m apart, with a tree every 3 to 4.5 m."""
    pitch, spacing, crown = rng.uniform(5, 6.5), rng.uniform(3, 4.5), rng.uniform(2.0, 2.7)
    skip = int(np.ceil(APART_M / pitch))
    plan = rows(length_m, run_m=rng.uniform(70, 110), pitch_m=skip * pitch, closed=closed, back_m=6.0, corner_m=2.0)
    across = pitch * (np.arange(-2 * skip, (plan.count + 1) * skip) + 0.5)
    trees = grid(np.arange(FREE_M, plan.run_m - FREE_M, spacing), across, lambda: _tree(rng, crown))
    ground = striped_ground(TERRAIN, [Strip(plan.line, -1.5, 1.5, OTHER_GROUND)], rolling(rng))
    return Site(plan.line, jittered(rng, trees, 0.12, keep=0.97), ground)


def _tree(rng: np.random.Generator, crown: float) -> Thing:
    """Trunk, and a crown whose width differs by up to 10 % from `crown`."""
    wide, high = crown * rng.uniform(0.9, 1.1), crown * rng.uniform(1.0, 1.3)
    leaves = Part("ellipsoid", VEGETATION, (wide, wide, high), bottom=0.8, roughness=0.5, porosity=0.5)
    return post(TRUNK, rng.uniform(0.12, 0.2), 1.8), leaves
