"""Open ground with few things, most of them far away."""

from collections.abc import Callable, Iterator

import numpy as np

from sglpr_jax.sim import plants
from sglpr_jax.sim.buildings import garage
from sglpr_jax.sim.raw_ids import OTHER_GROUND, POLE, TERRAIN
from sglpr_jax.sim.sceneries.site import Site, Spot, Strip, along, post, rolling, striped_ground
from sglpr_jax.sim.sceneries.ways import STEP_M, Line, road, shifted
from sglpr_jax.sim.things import Range, Thing


def field(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Track through fields, with posts or poles along it, some bushes, and single trees and sheds far away."""
    whole, driven = road(rng, length_m, closed)
    (every, thick, high), beside = ((4.0, 0.12, 1.2), (35.0, 0.3, 8.0))[rng.integers(2)], rng.choice((-1, 1)) * 5.0
    posts = along(shifted(whole, beside), lambda: (post(POLE, thick, high),), every)
    bushes = _scattered(rng, whole, rng.uniform(20, 50), (6.0, 25.0), lambda: plants.bush(rng))
    far = _scattered(rng, whole, rng.uniform(30, 80), (30.0, 75.0), lambda: _far(rng))
    ground = striped_ground(TERRAIN, [Strip(whole, -1.5, 1.5, OTHER_GROUND)], rolling(rng))
    return Site(driven, [*posts, *bushes, *far], ground)


def _scattered(
    rng: np.random.Generator, line: Line, every_m: float, away_m: Range, make: Callable[[], Thing]
) -> Iterator[Spot]:
    """Yields things at random positions beside a line, on average one per `every_m` metres."""
    for _ in range(round(len(line) * STEP_M / every_m)):
        away = np.array([rng.uniform(*away_m) * rng.choice((-1, 1))])
        row = int(rng.integers(1, len(line) - 1))
        x, y = shifted(line[row - 1 : row + 2], away)[1].tolist()
        yield Spot(make(), x, y, rng.uniform(0, 2 * np.pi))


def _far(rng: np.random.Generator) -> Thing:
    """Tree or, with probability 0.25, a shed."""
    return garage(rng, rng.uniform(5, 12)) if rng.random() < 0.25 else plants.tree(rng, (3.0, 7.0))
