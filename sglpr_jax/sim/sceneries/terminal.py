"""Container terminal: lanes between equal blocks of stacked containers."""

import numpy as np

from sglpr_jax.sim.raw_ids import OTHER_OBJECT, PARKING, POLE
from sglpr_jax.sim.sceneries.site import Site, block, even_ground, grid, jittered, post
from sglpr_jax.sim.sceneries.ways import rows

WIDE_M, HIGH_M = 2.44, 2.59
"""Width and height of a container, in metres."""
GAP_M = 0.35
"""Gap between two neighbouring stacks, in metres."""
LANE_M = 9.0
"""Width of the lanes between blocks, in metres."""
BLOCK_M = 55.0
"""Approximate length of a block and of the lane beside it, in metres."""
MORE = 1
"""Number of blocks before the first and after the last driven lane."""


def terminal(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Blocks five or six containers wide, with stacks of one to five containers, between lanes along x and along y."""
    wide, long, run = int(rng.integers(5, 7)), float(rng.choice((6.06, 12.19))), rng.uniform(95, 125)
    pitch, bay = wide * (WIDE_M + GAP_M) + LANE_M, long + GAP_M
    plan = rows(length_m, run_m=run, pitch_m=pitch, closed=closed, back_m=LANE_M / 2, corner_m=2.5)
    lanes = pitch * np.arange(-MORE - 1, plan.count + MORE)
    first, each = np.linspace(0, plan.run_m, 1 + max(1, round(plan.run_m / BLOCK_M)), retstep=True)
    middles = (np.arange((each - LANE_M) // bay) + 0.5) * bay
    xs = (first[:-1, None] + LANE_M / 2 + middles).ravel()
    ys = (lanes[:, None] + LANE_M / 2 + (np.arange(wide) + 0.5) * (WIDE_M + GAP_M)).ravel()
    stacks = grid(xs, ys, lambda: (block(OTHER_OBJECT, long, WIDE_M, HIGH_M * int(rng.integers(1, 6))),))
    masts = grid(first[:-1] + LANE_M / 2 - 1.0, lanes + LANE_M / 2 + 0.5, lambda: (post(POLE, 0.5, 20.0),))
    return Site(plan.line, [*jittered(rng, stacks, 0.04), *masts], even_ground(PARKING))
