"""Solar farm: rows of equal tilted panels."""

import numpy as np

from sglpr_jax.sim.raw_ids import OTHER_GROUND, OTHER_OBJECT, POLE, TERRAIN
from sglpr_jax.sim.sceneries.site import Site, Strip, block, grid, post, rolling, striped_ground
from sglpr_jax.sim.sceneries.ways import rows
from sglpr_jax.sim.things import Thing

APART_M = 22.0
"""Minimum distance between passes, in metres. The vehicle skips rows to keep this distance."""
FREE_M = 5.0
SLATS = 8
"""Number of level slats along the slope of a panel. Shapes have no tilt, so the slats imitate it."""


def solar(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Rows of panels 7 to 10 m apart. The panels are 8 to 16 m long and tilted by 15 to 30 degrees."""
    pitch, long, deep, tilt, low = rng.uniform((7, 8, 2.2, 15, 0.6), (10, 16, 3.8, 30, 1.0)).tolist()
    skip = int(np.ceil(APART_M / pitch))
    plan = rows(length_m, run_m=rng.uniform(80, 130), pitch_m=skip * pitch, closed=closed, back_m=6.0, corner_m=2.0)
    across = pitch * (np.arange(-2 * skip, (plan.count + 1) * skip) + 0.5)
    panel = _panel(long, deep, np.radians(tilt), low)
    panels = grid(np.arange(FREE_M + long / 2, plan.run_m - FREE_M - long / 2, long + 0.4), across, lambda: panel)
    ground = striped_ground(TERRAIN, [Strip(plan.line, -1.5, 1.5, OTHER_GROUND)], rolling(rng))
    return Site(plan.line, panels, ground)


def _panel(long: float, deep: float, tilt: float, low: float) -> Thing:
    """Table of panels along x that rises along y from `low` metres, on two rows of posts."""
    wide, step = np.cos(tilt) * deep / SLATS, np.sin(tilt) * deep / SLATS
    places = ((np.arange(SLATS) - (SLATS - 1) / 2) * wide).tolist()
    slats = [block(OTHER_OBJECT, long, wide, step + 0.02, y=y, bottom=low + k * step) for k, y in enumerate(places)]
    xs = np.linspace(-long / 2 + 1, long / 2 - 1, 4).tolist()
    posts = [post(POLE, 0.12, low + k * step, x, places[k]) for k in (1, SLATS - 2) for x in xs]
    return *slats, *posts
