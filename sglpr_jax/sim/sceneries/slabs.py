"""Estate of equal slab buildings along parallel streets, with trees and parked cars at random."""

import numpy as np

from sglpr_jax.sim import plants
from sglpr_jax.sim.raw_ids import BUILDING, POLE, ROAD, SIDEWALK, TERRAIN
from sglpr_jax.sim.sceneries.site import Site, Spot, Strip, block, grid, jittered, post, rolling, striped_ground
from sglpr_jax.sim.sceneries.ways import rows
from sglpr_jax.sim.things import Thing
from sglpr_jax.sim.vehicles import parked

ROAD_M, WALK_M = 3.8, 5.8
"""Half width of the carriageway, and half width of the street with its sidewalks, in metres."""
FREE_M = 10.0
"""Length of a crossing at both ends of a street, in metres."""
TREE_M = 14.0
"""Mean distance between two trees along one side of a street, in metres."""


def slabs(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Streets 44 to 56 m apart. Between each two of them, equal slabs stand in a row."""
    pitch, long, deep, high, gap = rng.uniform((44, 40, 11, 14, 12), (56, 60, 13, 26, 22)).tolist()
    plan = rows(length_m, run_m=2 * (long + gap), pitch_m=pitch, closed=closed, back_m=12.0, corner_m=4.0)
    streets = pitch * np.arange(-1, plan.count + 1)
    slab, middles = _slab(long, deep, high), np.arange(gap / 2 + long / 2, plan.run_m, long + gap)
    buildings = grid(middles, streets + pitch / 2, lambda: slab)
    xs, aside = np.arange(FREE_M, plan.run_m - FREE_M, 6.0), ROAD_M - 0.9
    bays = grid(xs, np.concatenate([streets - aside, streets + aside]), lambda: parked(rng))
    lamps = grid(xs[::5], streets + ROAD_M + 0.5, lambda: (post(POLE, 0.18, 7.0),))
    strips = [Strip(plan.line, -WALK_M, WALK_M, SIDEWALK), Strip(plan.line, -ROAD_M, ROAD_M, ROAD)]
    spots = [*buildings, *jittered(rng, bays, 0.2, keep=rng.uniform(0.3, 0.6)), *lamps]
    spots += _trees(rng, plan.run_m, streets, (pitch - deep) / 2)
    return Site(plan.line, spots, striped_ground(TERRAIN, strips, rolling(rng)))


def _trees(rng: np.random.Generator, run: float, streets: np.ndarray, edge: float) -> list[Spot]:
    """Trees and bushes at random between the sidewalks and the slabs, `edge` metres from the middle of the street."""
    spots = []
    for street in streets.tolist():
        for side in (-1, 1):
            for _ in range(round(run / TREE_M)):
                x, away = rng.uniform((0, WALK_M + 1.0), (run, edge - 2.0)).tolist()
                plant = plants.tree(rng, (2.5, 5.0)) if rng.random() < 0.7 else plants.bush(rng)
                spots.append(Spot(plant, x, street + side * away, rng.uniform(0, 2 * np.pi)))
    return spots


def _slab(long: float, deep: float, high: float) -> Thing:
    """Building along x with windows, and porches and balconies at equal distances."""
    body = block(BUILDING, long, deep, high + 1, bottom=-1.0, roughness=0.05, glass=0.25)
    entrances = np.arange(-long / 2 + 5, long / 2 - 4, 10.0).tolist()
    porches = [block(BUILDING, 3.0, 1.4, 2.8, x, -(deep + 1.4) / 2) for x in entrances]
    balconies = [block(BUILDING, 3.5, 1.2, high - 3.0, x, (deep + 1.2) / 2, bottom=2.5) for x in entrances]
    return body, *porches, *balconies
