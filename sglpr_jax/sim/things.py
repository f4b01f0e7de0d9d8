"""Things of a town, composed of boxes, cylinders and ellipsoids."""

from typing import Literal, NamedTuple

import numpy as np

Range = tuple[float, float]
"""Minimum and maximum of a uniform distribution."""
Kind = Literal["box", "cylinder", "ellipsoid"]
KINDS: tuple[Kind, ...] = ("box", "cylinder", "ellipsoid")
"""Kinds in the order of `shapes.Scene`."""


Zone = Literal["bay", "verge", "plot"]
"""Place of a thing: parked along its street, on the strips beside the road, or behind the strips."""


class Part(NamedTuple):
    """One shape of a thing, in metres and radians in the thing's frame: x forward, y left, z = 0 on the ground."""

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
"""Parts that stand, appear and disappear together."""


class Placed(NamedTuple):
    """Thing beside a street, s metres along the street and d metres outwards from the kerb."""

    thing: Thing
    s: float
    d: float
    yaw: float = 0.0  # of the thing's x axis relative to the street, positive outwards, radians
    zone: Zone = "plot"
    since: float = -np.inf  # seconds
    until: float = np.inf  # seconds
