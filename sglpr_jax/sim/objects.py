"""Objects of a town, made of boxes, cylinders and ellipsoids: plants, vehicles, people and buildings."""

from typing import Literal, NamedTuple

import numpy as np

from sglpr_jax.sim import labels

Range = tuple[float, float]
"""Minimum and maximum of a uniform distribution."""
Kind = Literal["box", "cylinder", "ellipsoid"]
KINDS: tuple[Kind, ...] = ("box", "cylinder", "ellipsoid")  # kinds in the order of `shapes.Scene`
_BELOW_M = 1.0  # depth of a building below the ground, in metres, against gaps on slopes
_FACADE_M = 0.06
"""Roughness of a facade, in metres. In real scans, points within 1 m of facade are 4 cm (rms) off their plane."""


class Primitive(NamedTuple):
    """One shape of an object, in metres and radians in the object's frame: x forward, y left, z = 0 on the ground."""

    kind: Kind
    label: int
    size: tuple[float, float, float]  # length, width, height
    x: float = 0.0  # of the centre
    y: float = 0.0
    bottom: float = 0.0  # z of the lower end
    yaw: float = 0.0
    roughness: float = 0.0  # this and the following fields: see `Shapes`
    porosity: float = 0.0
    glass: float = 0.0


ObjectModel = tuple[Primitive, ...]
"""Object: parts that stand, appear and disappear together."""


def block(label: int, length: float, width: float, height: float, x: float = 0.0, y: float = 0.0, **more) -> Primitive:
    """Box with its centre at x and y. `more` holds fields of `Primitive`."""
    return Primitive("box", label, (length, width, height), x, y, **more)


def post(label: int, thickness: float, height: float, x: float = 0.0, y: float = 0.0, **more) -> Primitive:
    """Cylinder with its axis at x and y. `more` holds fields of `Primitive`."""
    return Primitive("cylinder", label, (thickness, thickness, height), x, y, **more)


def ball(label: int, width: float, height: float, x: float = 0.0, y: float = 0.0, **more) -> Primitive:
    """Round ellipsoid with its axis at x and y, such as a crown of leaves. `more` holds fields of `Primitive`."""
    return Primitive("ellipsoid", label, (width, width, height), x, y, **more)


def tree(rng: np.random.Generator, spread: Range) -> ObjectModel:
    """Tree whose crown has a diameter in the range `spread`, in metres. A large crown has several ellipsoids."""
    crown, crown_bottom = rng.uniform(*spread), rng.uniform(0.9, 2.6)
    thickness = 0.12 + 0.05 * crown * rng.uniform(0.6, 1.4)
    parts = [post(labels.TRUNK, thickness, crown_bottom + 0.35 * crown)]
    lobes = 1 if crown < 3.5 else int(rng.integers(2, 5))
    for _ in range(lobes):
        size = crown * (1.0 if lobes == 1 else rng.uniform(0.6, 0.85))
        x, y = (rng.uniform(-0.5, 0.5, 2) * (crown - size)).tolist()
        bottom = crown_bottom + rng.uniform(0, 0.25) * crown * (lobes > 1)
        height = size * rng.uniform(0.8, 1.3)
        porosity = rng.uniform(0.45, 0.75)
        parts.append(ball(labels.VEGETATION, size, height, x, y, bottom=bottom, roughness=0.7, porosity=porosity))
    return tuple(parts)


def limbed_tree(rng: np.random.Generator, spread: Range) -> ObjectModel:
    """Old street tree: a thick trunk and bare limbs under a crown that begins above most lasers."""
    crown, fork = rng.uniform(*spread), rng.uniform(1.2, 2.2)
    thickness = rng.uniform(0.25, 0.7)
    parts = [post(labels.TRUNK, thickness, fork + 1.5, roughness=0.05)]
    for _ in range(int(rng.integers(1, 4))):
        width, height = rng.uniform((0.6, 0.7), (2.2, 1.8)).tolist()
        x, y = rng.uniform(-0.4, 0.4, 2).tolist()
        parts.append(ball(labels.TRUNK, width, height, x, y, bottom=fork - 0.2, roughness=0.4, porosity=0.8))
    bottom, porosity = fork + rng.uniform(-0.3, 1.6), rng.uniform(0.55, 0.85)
    parts.append(ball(labels.VEGETATION, crown, crown, bottom=bottom, roughness=0.9, porosity=porosity))
    return tuple(parts)


def conifer(rng: np.random.Generator) -> ObjectModel:
    """Conifer with a crown that reaches the ground."""
    width = rng.uniform(1.5, 4)
    crown = ball(labels.VEGETATION, width, 3 * width, bottom=-0.8 * width, roughness=0.5, porosity=0.45)
    return post(labels.TRUNK, 0.3, 1.5), crown


def bush(rng: np.random.Generator, scale: float = 1.0) -> ObjectModel:
    """Bush of one or two ellipsoids, the second at a random offset. `scale` multiplies their size."""
    parts = []
    scale *= rng.uniform(0.6, 1.7)
    for i in range(int(rng.integers(1, 3))):
        length, width, height = scale * rng.uniform((0.8, 0.8, 0.7), (3.0, 2.0, 2.4))
        x, y = (i * rng.uniform(-0.5, 0.5, 2) * (length, width)).tolist()
        size, yaw = (length, width, 1.4 * height), rng.uniform(0, np.pi)
        options = {"bottom": -0.4 * height, "yaw": yaw, "roughness": 0.45, "porosity": 0.45}
        parts.append(Primitive("ellipsoid", labels.VEGETATION, size, x, y, **options))
    return tuple(parts)


def hedge(
    length: float, thickness: float, height: float, *, roughness: float = 0.3, porosity: float = 0.25
) -> ObjectModel:
    """Trimmed hedge along x."""
    size = length, thickness, height + 0.3
    return (block(labels.VEGETATION, *size, bottom=-0.3, roughness=roughness, porosity=porosity),)


def hedgerow(rng: np.random.Generator, length: float, thickness: float, height: float) -> ObjectModel:
    """Piece of an overgrown hedge along x: a dense face, with leaves behind it (y > 0) that become thinner."""
    parts = [*hedge(length, thickness, height, roughness=0.12, porosity=rng.uniform(0.2, 0.5))]
    layer_y = thickness / 2  # front of the next layer of leaves
    for porosity in (0.55, 0.7, 0.8)[: int(rng.integers(0, 4))]:
        layer_depth, layer_height = rng.uniform(0.5, 1.3), height * rng.uniform(0.9, 1.7)
        (layer,) = hedge(length, layer_depth, layer_height, roughness=0.6, porosity=porosity)
        parts.append(layer._replace(y=layer_y + layer_depth / 2))
        layer_y += layer_depth
    return tuple(parts)


def thicket(rng: np.random.Generator) -> ObjectModel:
    """Piece of the edge of a wood: undergrowth with visible trunks."""
    parts = [*bush(rng, rng.uniform(1.2, 2.4))]
    for _ in range(int(rng.integers(1, 4))):
        x, y = rng.uniform(-2.5, 2.5, 2).tolist()
        thickness = rng.uniform(0.15, 0.45)
        parts.append(post(labels.TRUNK, thickness, rng.uniform(4, 8), x, y))
        crown = rng.uniform(2.5, 5)
        bottom = rng.uniform(1.0, 3.5)
        porosity = rng.uniform(0.5, 0.75)
        parts.append(ball(labels.VEGETATION, crown, 1.5 * crown, x, y, bottom=bottom, roughness=0.9, porosity=porosity))
    return tuple(parts)


def car(rng: np.random.Generator) -> ObjectModel:
    """Car: a body of full length, with a shorter and narrower cabin on top."""
    length, width, height = rng.uniform(3.7, 4.8), rng.uniform(1.65, 1.85), rng.uniform(1.4, 1.65)
    cabin_length, cabin_shift = rng.uniform(0.45, 0.7) * length, rng.uniform(0, 0.12) * length
    return (
        block(labels.CAR, length, width, 0.4 * height, bottom=0.22),
        block(labels.CAR, cabin_length, 0.88 * width, 0.4 * height, x=-cabin_shift, bottom=0.6 * height),
    )


def van(rng: np.random.Generator) -> ObjectModel:
    length, height = rng.uniform(4.8, 5.8), rng.uniform(1.8, 2.5)
    return (
        block(labels.OTHER_VEHICLE, length, 1.95, 0.45 * height, bottom=0.25),
        block(labels.OTHER_VEHICLE, 0.8 * length, 1.85, height - 0.3, x=-0.1 * length, bottom=0.3),
    )


def truck(rng: np.random.Generator) -> ObjectModel:
    """Truck: a cab and, behind a gap, the load."""
    length, height = rng.uniform(6, 9), rng.uniform(2.7, 3.6)
    return (
        block(labels.TRUCK, 1.9, 2.2, 2.3, x=length / 2 - 0.95, bottom=0.45),
        block(labels.TRUCK, length - 2.3, 2.35, height - 0.9, x=-1.15, bottom=0.9),
    )


def bus(rng: np.random.Generator) -> ObjectModel:
    return (block(labels.BUS, rng.uniform(10, 12.5), 2.5, 2.8, bottom=0.3),)


def bicycle(rng: np.random.Generator) -> ObjectModel:
    return (block(labels.BICYCLE, rng.uniform(1.6, 1.8), 0.15, 1.0, porosity=0.5),)


def motorcycle(rng: np.random.Generator) -> ObjectModel:
    return (block(labels.MOTORCYCLE, rng.uniform(1.9, 2.2), 0.45, 1.1, bottom=0.05),)


def _rider(rng: np.random.Generator, label: int, vehicle: Primitive) -> ObjectModel:
    """Person on a vehicle of one part. Both have the label `label`."""
    body = Primitive("cylinder", label, (0.4, 0.45, rng.uniform(1.6, 1.85) - 0.7), bottom=0.7)
    return vehicle._replace(label=label), body


def bicyclist(rng: np.random.Generator) -> ObjectModel:
    return _rider(rng, labels.BICYCLIST, *bicycle(rng))


def motorcyclist(rng: np.random.Generator) -> ObjectModel:
    return _rider(rng, labels.MOTORCYCLIST, *motorcycle(rng))


def person(rng: np.random.Generator) -> ObjectModel:
    return (
        Primitive("cylinder", labels.PERSON, (rng.uniform(0.3, 0.5), rng.uniform(0.4, 0.6), rng.uniform(1.5, 1.9))),
    )


def people(rng: np.random.Generator) -> ObjectModel:
    """One to three people side by side, including their arms and bags."""
    parts = []
    for k in range(int(rng.integers(1, 4))):
        depth, width, height = rng.uniform((0.35, 0.5, 1.5), (0.6, 0.8, 1.9)).tolist()
        x, y = rng.uniform(-0.15, 0.15, 2).tolist()
        parts.append(Primitive("cylinder", labels.PERSON, (depth, width, height), x, y + 0.75 * k, roughness=0.12))
    return tuple(parts)


def moving(thing: ObjectModel) -> ObjectModel:
    """Returns `thing` with the labels of the moving classes, see `labels.MOVING`."""
    return tuple(part._replace(label=labels.MOVING[part.label]) for part in thing)


def parked(rng: np.random.Generator) -> ObjectModel:
    """Parked vehicle, mostly a car."""
    return (car, van, truck)[rng.choice(3, p=[0.955, 0.03, 0.015])](rng)


class House(NamedTuple):
    """Size of a house in metres, and the fraction of its facade that is window."""

    width: float
    depth: float
    height: float
    glass: float


def _building_block(
    width: float, depth: float, height: float, *, x: float = 0.0, front: float = 0.0, glass: float = 0.0
) -> Primitive:
    """Box with its front at y = `front`. It extends below the ground."""
    size = width, depth, height + _BELOW_M
    return Primitive("box", labels.BUILDING, size, x, front + depth / 2, -_BELOW_M, roughness=_FACADE_M, glass=glass)


def house(rng: np.random.Generator, plan: House, *, porch: bool) -> ObjectModel:
    """House with the middle of its front at the origin, and y into the house, perhaps with a wing and balconies.

    With `porch`, three of ten houses have a porch in front.
    """
    width, depth, height, glass = plan
    parts = [_building_block(width, depth, height, glass=glass)]
    if width > 5 and rng.random() < 0.65:
        side, fraction, recess = rng.choice((-1, 1)), rng.uniform(0.25, 0.6), rng.uniform(0.6, 2.5)
        wing_width = fraction * width
        main = _building_block(width - wing_width, depth, height, x=-side * wing_width / 2, glass=glass)
        wing_x, wing_height = side * (width - wing_width) / 2, height * rng.uniform(0.5, 1.0)
        wing = _building_block(wing_width, depth - recess, wing_height, x=wing_x, front=recess, glass=glass)
        parts = [main, wing]
    if porch and rng.random() < 0.3:
        x = rng.uniform(-0.4, 0.4) * (width - 1.6)
        parts.append(_building_block(1.6, 1.2, 2.6, x=x, front=-1.0, glass=glass))
    if height > 6 and rng.random() < 0.35:
        length, x = rng.uniform(2, 0.4 * width + 2), rng.uniform(-0.2, 0.2) * width
        for storey in range(1, int(height / 3)):  # one balcony for each upper storey
            parts.append(block(labels.BUILDING, length, 1.3, 1.1, x, -0.6, bottom=3.0 * storey - 0.2))
    return tuple(parts)


def garage(rng: np.random.Generator, width: float) -> ObjectModel:
    """Garage or shed with its front at the origin."""
    return (_building_block(width, rng.uniform(4, 6.5), rng.uniform(2.2, 3.0)),)
