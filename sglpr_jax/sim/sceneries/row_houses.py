"""Row houses: one house with its garden, repeated along parallel streets."""

import numpy as np

from sglpr_jax.sim.plants import hedge
from sglpr_jax.sim.raw_ids import BUILDING, FENCE, POLE, ROAD, SIDEWALK, TERRAIN, TRUNK, VEGETATION
from sglpr_jax.sim.sceneries.site import Site, Spot, Strip, block, grid, jittered, post, rolling, striped_ground
from sglpr_jax.sim.sceneries.ways import rows
from sglpr_jax.sim.things import Part, Thing
from sglpr_jax.sim.vehicles import parked

ROAD_M, WALK_M = 3.8, 5.6
"""Half width of the carriageway, and half width of the street with its sidewalks, in metres."""
FREE_M = 12.0
"""Length of a crossing at both ends of a street, in metres."""


def row_houses(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Streets of equal houses, 46 to 56 m apart. Different cars are parked in front of the houses."""
    pitch, wide = rng.uniform(46, 56), rng.uniform(5.5, 9)
    plan = rows(length_m, run_m=rng.uniform(110, 160), pitch_m=pitch, closed=closed, back_m=12.0, corner_m=4.0)
    streets = pitch * np.arange(-1, plan.count + 1)
    module, xs = _module(rng, wide), np.arange(FREE_M + wide / 2, plan.run_m - FREE_M, wide)
    houses = [spot for side in (1, -1) for spot in grid(xs, streets, lambda: module, side=side)]
    bays = [spot for side in (1, -1) for spot in _parked(rng, xs, streets, side)]
    lamps = grid(xs[:: max(1, round(30 / wide))] + wide / 2, streets + ROAD_M + 0.5, lambda: (post(POLE, 0.18, 6.0),))
    strips = [Strip(plan.line, -WALK_M, WALK_M, SIDEWALK), Strip(plan.line, -ROAD_M, ROAD_M, ROAD)]
    ground = striped_ground(TERRAIN, strips, rolling(rng))
    return Site(plan.line, [*houses, *jittered(rng, bays, 0.2, keep=rng.uniform(0.2, 0.5)), *lamps], ground)


def _parked(rng: np.random.Generator, xs: np.ndarray, streets: np.ndarray, side: int) -> list[Spot]:
    """Parked vehicle at the kerb in front of each house."""
    return grid(xs, streets + side * (ROAD_M - 0.9), lambda: parked(rng))


def _module(rng: np.random.Generator, wide: float) -> Thing:
    """House with wing, porch, shed, and a front garden with fences and a tree.

    The y axis points from the middle of the street to the house.
    """
    garden, deep, high, recess = rng.uniform((3, 8, 5.5, 0.5), (7, 11, 9, 2.5)).tolist()
    front, main = WALK_M + garden, rng.choice((1.0, 0.7)) * wide
    house = block(BUILDING, main, deep, high + 1, 0.0, front + deep / 2, bottom=-1.0, roughness=0.06, glass=0.2)
    wing = block(BUILDING, wide, deep - recess, 3.5, 0.0, front + recess + (deep - recess) / 2, bottom=-0.5)
    porch = block(BUILDING, 1.4, 1.2, 2.6, rng.uniform(-0.25, 0.25) * wide, front - 0.6)
    shed = block(BUILDING, 2.4, 2.0, 2.3, 0.3 * wide, front + deep + rng.uniform(3, 5))
    gate = rng.uniform(1.0, 2.5)
    border = _border(rng, wide - gate)._replace(x=-gate / 2, y=WALK_M + 0.4)
    between = block(FENCE, 0.1, garden - 0.6, 1.0, wide / 2, WALK_M + garden / 2, porosity=0.3)
    return (
        house,
        wing,
        porch,
        shed,
        border,
        between,
        *_small_tree(rng, rng.uniform(-0.3, 0.3) * wide, front - garden / 2),
    )


def _border(rng: np.random.Generator, length: float) -> Part:
    """Hedge or fence of this length."""
    if rng.random() < 0.5:
        return hedge(length, rng.uniform(0.4, 0.9), rng.uniform(0.9, 1.6))[0]
    return block(FENCE, length, 0.1, rng.uniform(0.8, 1.2), porosity=0.4)


def _small_tree(rng: np.random.Generator, x: float, y: float) -> Thing:
    """Tree in a front garden."""
    crown = rng.uniform(1.5, 2.5)
    leaves = Part("ellipsoid", VEGETATION, (crown, crown, crown), x, y, 1.3, roughness=0.6, porosity=0.5)
    return post(TRUNK, 0.15, 2.0, x, y), leaves
