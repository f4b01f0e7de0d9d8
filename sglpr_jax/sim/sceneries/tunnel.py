"""Road tunnel: walls, ceiling, lamps, and emergency niches at equal distances."""

import numpy as np

from sglpr_jax.sim.raw_ids import BUILDING, OTHER_OBJECT, ROAD
from sglpr_jax.sim.sceneries.site import OVERLAP, Site, along, block, even_ground
from sglpr_jax.sim.sceneries.ways import road
from sglpr_jax.sim.things import Thing

PIECE_M = 6.0
THICK_M = 2.0
"""Thickness of the walls, in metres. It exceeds the depth of a niche, so neighbouring pieces close its sides."""
NICHE_M = 1.3


def tunnel(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Tunnel of equal pieces of length PIECE_M. Every n-th piece has a niche on the right."""
    whole, driven = road(rng, length_m, closed)
    half, height, every = rng.uniform(3.8, 5.5), rng.uniform(4.8, 6.5), int(rng.integers(7, 16))
    pieces = along(whole, lambda: _piece(half, height, 0.0), PIECE_M)
    pieces[::every] = along(whole, lambda: _piece(half, height, NICHE_M), every * PIECE_M)
    lamp = (block(OTHER_OBJECT, 1.2, 0.4, 0.25, y=rng.choice((0.0, half - 1)), bottom=height - 0.3),)
    return Site(driven, [*pieces, *along(whole, lambda: lamp, rng.uniform(8, 14))], even_ground(ROAD))


def _piece(half: float, height: float, niche: float) -> Thing:
    long, away = OVERLAP * PIECE_M, half + THICK_M / 2
    wall = block(BUILDING, long, THICK_M, height + 0.5, y=away, roughness=0.02)
    ceiling = block(BUILDING, OVERLAP * PIECE_M, 2 * half + 1, 0.5, bottom=height, roughness=0.02)
    return wall, wall._replace(y=-away - niche), ceiling
