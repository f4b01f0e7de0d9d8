"""How the things of a town are put together from boxes, cylinders and ellipsoids."""

from typing import Literal, NamedTuple

import numpy as np

Range = tuple[float, float]
"""Lowest and highest value of a uniform distribution."""
Kind = Literal["box", "cylinder", "ellipsoid"]
KINDS: tuple[Kind, ...] = ("box", "cylinder", "ellipsoid")
"""In the order of shapes.Scene."""


Zone = Literal["bay", "verge", "plot"]
"""Where a thing belongs: parked along its own street, on the strips beside the road, or behind them."""


class Part(NamedTuple):
    """One shape of a thing, in the thing's own frame: x forward, y left, z = 0 on the ground; metres and radians."""

    kind: Kind
    label: int
    size: tuple[float, float, float]  # length, width, height
    x: float = 0.0
    y: float = 0.0
    bottom: float = 0.0
    yaw: float = 0.0
    roughness: float = 0.0
    porosity: float = 0.0
    glass: float = 0.0


Thing = tuple[Part, ...]
"""What stands, comes and goes as one."""


class Placed(NamedTuple):
    """A thing beside a street: s metres along it, d metres outwards from the kerb."""

    thing: Thing
    s: float
    d: float
    yaw: float = 0.0  # of the thing's x axis against the street, turning outwards
    zone: Zone = "plot"
    since: float = -np.inf  # seconds
    until: float = np.inf
