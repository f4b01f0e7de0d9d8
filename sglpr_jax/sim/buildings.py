"""Buildings made of boxes at different depths, with windows, porches, balconies and garages."""

import dataclasses

import numpy as np

from sglpr_jax.sim.raw_ids import BUILDING
from sglpr_jax.sim.things import Part, Thing

_BELOW_M = 1.0
"""Depth of a building below the ground, in metres. It prevents gaps under buildings on slopes."""
_FACADE_M = 0.06
"""Roughness of a facade, in metres. In real scans, points within 1 m of facade are 4 cm (rms) off their plane."""


@dataclasses.dataclass(frozen=True)
class House:
    """Size of a house in metres, and the fraction of its facade that is window."""

    width: float
    depth: float
    height: float
    glass: float


def _block(width: float, depth: float, height: float, x: float, front: float, glass: float) -> Part:
    """Box with its front at y = `front`. It extends below the ground."""
    size = width, depth, height + _BELOW_M
    return Part("box", BUILDING, size, x, front + depth / 2, -_BELOW_M, roughness=_FACADE_M, glass=glass)


def house(rng: np.random.Generator, plan: House, *, porch: bool) -> Thing:
    """House with the middle of its front at the origin. The y axis points into the house.

    About two of three houses have a recess or a wing: a second box at another depth. Some houses have balconies. With
    `porch`, which needs room in front of the house, some have a porch.
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
    """Garage or shed with its front at the origin."""
    return (_block(width, rng.uniform(4, 6.5), rng.uniform(2.2, 3.0), 0.0, 0.0, 0.0),)
