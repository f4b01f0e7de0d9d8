"""Buildings: boxes at different depths with windows, porches, balconies and garages."""

import dataclasses

import numpy as np

from sglpr_jax.sim.raw_ids import BUILDING
from sglpr_jax.sim.things import Part, Thing

_BELOW_M = 1.0
"""How deep a building reaches into the ground, so that none hovers on a slope."""
_FACADE_M = 0.06
"""How uneven a facade is: in real scans the points of a metre of facade lie 4 cm (rms) off their plane."""


@dataclasses.dataclass(frozen=True)
class House:
    """The size of a house, metres, and the share of its facade that is window."""

    width: float
    depth: float
    height: float
    glass: float


def _block(width: float, depth: float, height: float, x: float, front: float, glass: float) -> Part:
    """A box whose front is at y = `front`, standing in the ground."""
    size = width, depth, height + _BELOW_M
    return Part("box", BUILDING, size, x, front + depth / 2, -_BELOW_M, roughness=_FACADE_M, glass=glass)


def house(rng: np.random.Generator, plan: House, *, porch: bool) -> Thing:
    """A house with the middle of its front at the origin; y leads into it.

    Two of three have a recess or a wing: a second box at another depth. Some have balconies; where there is room in
    front for a `porch`, some have one.
    """
    width, depth, height = plan.width, plan.depth, plan.height
    parts = [_block(width, depth, height, 0.0, 0.0, plan.glass)]
    if width > 5 and rng.random() < 0.65:
        side, share, recess = rng.choice((-1, 1)), rng.uniform(0.25, 0.6), rng.uniform(0.6, 2.5)
        wing = share * width
        main = _block(width - wing, depth, height, -side * wing / 2, 0.0, plan.glass)
        lower = height * rng.uniform(0.5, 1.0)
        parts = [main, _block(wing, depth - recess, lower, side * (width - wing) / 2, recess, plan.glass)]
    if porch and rng.random() < 0.3:
        x = rng.uniform(-0.4, 0.4) * (width - 1.6)
        parts.append(_block(1.6, 1.2, 2.6, x, -1.0, plan.glass))
    if height > 6 and rng.random() < 0.35:
        length, x = rng.uniform(2, 0.4 * width + 2), rng.uniform(-0.2, 0.2) * width
        for storey in range(1, int(height / 3)):
            parts.append(Part("box", BUILDING, (length, 1.3, 1.1), x, -0.6, 3.0 * storey - 0.2))
    return tuple(parts)


def garage(rng: np.random.Generator, width: float) -> Thing:
    """A garage or a shed, its front at the origin."""
    return (_block(width, rng.uniform(4, 6.5), rng.uniform(2.2, 3.0), 0.0, 0.0, 0.0),)
