"""Long bridge: deck, railings, hangers, pylons and lamps at equal distances, above water or a valley."""

import numpy as np

from sglpr_jax.sim.raw_ids import BUILDING, FENCE, LANE_MARKING, NO_RETURN, POLE, ROAD
from sglpr_jax.sim.sceneries.site import OVERLAP, Site, Strip, along, block, post, striped_ground
from sglpr_jax.sim.sceneries.ways import road
from sglpr_jax.sim.things import Part, Thing

POST_M = 2.0
"""Distance between two posts of a railing, in metres."""


def bridge(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Deck with railings on both sides, half of the time with hangers. Rays beyond the deck do not return."""
    whole, driven = road(rng, length_m, closed)
    half, rail, hang, lit, span = rng.uniform((5, 0.9, 8, 25, 120), (8, 1.3, 15, 45, 260)).tolist()
    bars = [block(FENCE, OVERLAP * POST_M, 0.06, 0.08, y=half, bottom=z * rail) for z in (0.5, 0.95)]
    kerb = block(FENCE, OVERLAP * POST_M, 0.3, 0.25, y=half)
    things = [(_both(*bars, kerb, post(FENCE, 0.1, rail, y=half)), POST_M)]
    if rng.random() < 0.5:
        things.append((_both(post(POLE, 0.16, 14.0, y=half + 0.6)), hang))
    lamp = post(POLE, 0.2, 8.0, y=half + 0.3)
    things.append((_both(lamp) if rng.random() < 0.5 else (lamp,), lit))
    legs = _both(block(BUILDING, 2.5, 2.0, 30.0, y=half + 1.8))
    things.append(((*legs, block(BUILDING, 1.5, 2 * half + 2, 2.0, bottom=6.5)), span))
    spots = [spot for thing, every in things for spot in along(whole, lambda thing=thing: thing, every)]
    lines = [Strip(whole, 0.0, 0.2, LANE_MARKING, 4.0), *(Strip(whole, y, y + 0.2, LANE_MARKING) for y in (-3.6, 3.4))]
    return Site(driven, spots, striped_ground(NO_RETURN, [Strip(whole, -half - 0.3, half + 0.3, ROAD), *lines]))


def _both(*parts: Part) -> Thing:
    """Parts and their mirror images."""
    return *parts, *(part._replace(y=-part.y) for part in parts)
