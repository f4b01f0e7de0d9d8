"""Two plain walls along a road."""

import numpy as np

from sglpr_jax.sim.raw_ids import FENCE, ROAD
from sglpr_jax.sim.sceneries.site import OVERLAP, Site, along, block, even_ground
from sglpr_jax.sim.sceneries.ways import road

PIECE_M = 4.0
THICK_M = 0.4


def walls(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Road between two walls without features."""
    whole, driven = road(rng, length_m, closed)
    left, right, height = rng.uniform(3.5, 8), rng.uniform(3, 7), rng.uniform(1.8, 4)
    pair = tuple(
        block(FENCE, OVERLAP * PIECE_M, THICK_M, height, y=y, roughness=0.02)
        for y in (left + THICK_M / 2, -right - THICK_M / 2)
    )
    return Site(driven, along(whole, lambda: pair, PIECE_M), even_ground(ROAD))
