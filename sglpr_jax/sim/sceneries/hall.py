"""Hall: columns at equal distances, and machines, shelves and crates of random size."""

import numpy as np

from sglpr_jax.sim.raw_ids import BUILDING, OTHER_GROUND, OTHER_OBJECT, POLE
from sglpr_jax.sim.sceneries.enclosed import anywhere, places
from sglpr_jax.sim.sceneries.site import Site, Spot, block, even_ground, grid
from sglpr_jax.sim.things import Thing

AREA_M2 = 40.0
"""Area for each thing in a hall, in square metres."""


def hall(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Halls of 30 to 60 m with equal walls and columns and different things, joined by gates.

    A closed path stays in one hall.
    """
    long, wide, height, span = rng.uniform((30, 30, 5, 6), (60, 45, 9, 10)).tolist()
    plan = places(rng, length_m, closed, long_m=long, wide_m=wide, height_m=height)
    column, along = (block(POLE, 0.4, 0.4, height),), plan.count * long
    columns = grid(np.arange(span / 2, along, span), np.arange((span - wide) / 2, wide / 2, span), lambda: column)
    ceiling = block(BUILDING, along, wide, 0.3, along / 2, bottom=height, roughness=0.02)
    spots = [Spot((*plan.walls, ceiling), 0.0, 0.0), *columns]
    for k in range(plan.count):
        count = round(long * wide / AREA_M2 * rng.uniform(0.7, 1.3))
        for x, y, heading in anywhere(rng, count, long_m=long, wide_m=wide, away_m=2.5):
            turned = heading if rng.random() < 0.3 else round(2 * heading / np.pi) * np.pi / 2
            spots.append(Spot(_thing(rng), x + k * long, y, turned))
    return Site(plan.line, spots, even_ground(OTHER_GROUND))


def _thing(rng: np.random.Generator) -> Thing:
    """Machine, shelf or stack of crates."""
    match rng.integers(3):
        case 0:
            long, wide, high = rng.uniform((1.5, 1.0, 1.0), (5.0, 2.5, 2.2)).tolist()
            x, tower = rng.uniform(-0.3, 0.3) * long, rng.uniform(0.3, 1.5)
            body = block(OTHER_OBJECT, long, wide, high)
            return body, block(OTHER_OBJECT, 0.35 * long, 0.7 * wide, tower, x, bottom=high)
        case 1:
            long, wide, high = rng.uniform((2.0, 0.5, 1.8), (6.0, 1.1, 4.0)).tolist()
            return (block(OTHER_OBJECT, long, wide, high, roughness=0.15, porosity=0.25),)
        case _:
            size = rng.uniform(0.6, 1.3, 3)
            return tuple(
                block(OTHER_OBJECT, *(size * rng.uniform(0.8, 1.1, 3)).tolist(), x=1.4 * k)
                for k in range(int(rng.integers(1, 4)))
            )
