"""Yard: walls around a small area, with things that stand about. A scan shows all of it."""

import numpy as np

from sglpr_jax.sim import plants
from sglpr_jax.sim.raw_ids import OTHER_OBJECT, PARKING, POLE
from sglpr_jax.sim.sceneries.enclosed import anywhere, places
from sglpr_jax.sim.sceneries.site import Site, Spot, block, even_ground, post
from sglpr_jax.sim.things import Thing
from sglpr_jax.sim.vehicles import bicycle, car

AREA_M2 = 22.0
"""Area for each thing in a yard, in square metres."""


def yard(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Yards of 15 to 24 m with equal walls and different things, joined by gates. A closed path stays in one yard."""
    long, wide, height = rng.uniform((15, 15, 3), (24, 24, 8)).tolist()
    plan = places(rng, length_m, closed, long_m=long, wide_m=wide, height_m=height)
    spots = [Spot(plan.walls, 0.0, 0.0)]
    for k in range(plan.count):
        count = round(long * wide / AREA_M2 * rng.uniform(0.7, 1.3))
        where = anywhere(rng, count, long_m=long, wide_m=wide)
        spots += [Spot(_thing(rng), x + k * long, y, heading) for x, y, heading in where]
        spots += _annexes(rng, k * long, long, wide)
    return Site(plan.line, spots, even_ground(PARKING))


def _thing(rng: np.random.Generator) -> Thing:
    """Crate, bin, barrel, pole, plant or vehicle."""
    long, wide, high = rng.uniform((0.4, 0.4, 0.6), (1.8, 1.4, 2.6)).tolist()
    match rng.choice(6, p=[0.45, 0.15, 0.1, 0.2, 0.05, 0.05]):
        case 0:
            return (block(OTHER_OBJECT, long, wide, high),)
        case 1:
            return (post(OTHER_OBJECT, wide, 0.6 * high),)
        case 2:
            return (post(POLE, 0.12, 2 * high),)
        case 3:
            return plants.tree(rng, (1.5, 3.5)) if rng.random() < 0.4 else plants.bush(rng, 0.7)
        case 4:
            return car(rng)
        case _:
            return bicycle(rng)


def _annexes(rng: np.random.Generator, x: float, long: float, wide: float) -> list[Spot]:
    """Sheds, stairs and ducts at the two walls along x."""
    spots = []
    for side in (-1, 1):
        for place in rng.uniform(2.0, long - 2.0, int(rng.integers(1, 4))).tolist():
            length, deep, high = rng.uniform((0.5, 0.4, 1.0), (3.0, 1.6, 3.0)).tolist()
            spots.append(Spot((block(OTHER_OBJECT, length, deep, high),), x + place, side * (wide - deep - 0.3) / 2))
    return spots
