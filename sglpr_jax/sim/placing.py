"""Conversion of things beside streets to shapes in the world, clear of the vehicle and of other streets."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from sglpr_jax.sim.frontage import Clock, bystanders, frontage
from sglpr_jax.sim.ground import Ground, surface_height
from sglpr_jax.sim.shapes import Scene, Shapes
from sglpr_jax.sim.streets import Island, Network, runs
from sglpr_jax.sim.things import KINDS, Part, Placed

CLEARANCE_M = 1.6
"""Minimum distance of standing things from the vehicle's path, in metres."""

_TOLERANCE_M = 0.3
_HEAD_ROOM_M = 2.0
"""Minimum height of parts that may overhang a street or its sidewalk, in metres."""


class Anchors(NamedTuple):
    """Poses of the frames of things in the world, one row per part. `side` is -1 if y is mirrored."""

    xy: np.ndarray  # (n, 2) metres
    heading: np.ndarray  # (n,) radians
    side: np.ndarray  # (n,) 1 or -1
    since: np.ndarray  # (n,) seconds, start of the presence
    until: np.ndarray  # (n,) seconds, end of the presence


_NO_ROWS = Shapes(
    **dict.fromkeys(("centre", "half"), np.zeros((0, 3))),
    **dict.fromkeys(("yaw", "roughness", "porosity", "glass", "since", "until"), np.zeros(0)),
    label=np.zeros(0, np.int32),
    velocity=np.zeros((0, 2)),
)


def place(parts: list[Part], anchors: Anchors, ground: Ground) -> Shapes:
    """Converts parts of all kinds to one table of shapes in the world. Things stand on the ground at their anchors."""
    x, y, bottom, yaw, size = (
        np.array([getattr(part, field) for part in parts], dtype=np.float64).reshape(len(parts), *more)
        for field, *more in (("x",), ("y",), ("bottom",), ("yaw",), ("size", 3))
    )
    cos, sin, across = np.cos(anchors.heading), np.sin(anchors.heading), anchors.side * y
    xy = anchors.xy + np.stack([cos * x - sin * across, sin * x + cos * across], axis=1)
    z = surface_height(ground, anchors.xy) + bottom + size[:, 2] / 2
    roughness, porosity, glass = (
        np.array([getattr(part, field) for part in parts], dtype=np.float64)
        for field in ("roughness", "porosity", "glass")
    )
    return Shapes(
        centre=np.concatenate([xy, z[:, None]], axis=1),
        half=size / 2,
        yaw=anchors.heading + anchors.side * yaw,
        label=np.array([part.label for part in parts], dtype=np.int32),
        roughness=roughness,
        porosity=porosity,
        glass=glass,
        velocity=np.zeros((len(parts), 2)),
        since=anchors.since,
        until=anchors.until,
    )


def select(shapes: Shapes, keep: np.ndarray) -> Shapes:
    """Selects rows of `shapes` by a mask or by indices."""
    return Shapes(*(leaf[keep] for leaf in shapes))


def join(*tables: Shapes) -> Shapes:
    """Concatenates the rows of the tables. Without tables, the result is empty."""
    return Shapes(*(np.concatenate(leaves) for leaves in zip(_NO_ROWS, *tables, strict=True)))


def to_scene(shapes: Shapes, parts: list[Part]) -> Scene:
    """Splits a table into boxes, cylinders and ellipsoids, given the part of each row."""
    kinds = np.array([part.kind for part in parts])
    return Scene(*(select(shapes, kinds == kind) for kind in KINDS))


def furnish(
    rng: np.random.Generator,
    network: Network,
    islands: tuple[Island, ...],
    ground: Ground,
    path: Float[np.ndarray, "n 2"],
    clock: Clock,
) -> tuple[Shapes, list[Part]]:
    """Places things along the streets of `network`, clear of the streets and of `path`.

    Returns the shapes, and the part that each shape belongs to.
    """
    placed, place_of = [], []
    makers = bystanders(rng)
    for stretch, side_index, first, start, stop in _spans(network):
        side = (stretch.left, stretch.right)[side_index]
        for item in frontage(rng, side, start, stop, clock, makers):
            placed.append(item)
            along = first + np.clip(item.s, 0, stretch.stop - 0.01)
            place_of.append((along, 1 - 2 * side_index, stretch.half_width + item.d))
    along, side, across = np.array(place_of, dtype=np.float64).reshape(-1, 3).T
    thing, parts = _parts(placed)
    anchors = _anchors(network, along, side, across, placed, thing)
    shapes = place(parts, anchors, ground)
    street = network.street[along.astype(int)][thing]
    zone = np.array([item.zone for item in placed])[thing]
    bad = _on_a_street(network, shapes, street, zone, np.array([part.bottom for part in parts]))
    bad |= _in_the_way(shapes, path) | _on_an_island(shapes, islands)
    keep = ~np.isin(thing, thing[bad])
    return select(shapes, keep), [parts[i] for i in np.flatnonzero(keep)]


def _spans(network: Network) -> Iterator[tuple]:
    """Yields stretch, side (0 left, 1 right), first point of the street, and the bounds in s of each free interval."""
    free = _free(network)
    first, index = 0, 0
    for street in network.streets:
        for stretch in street.stretches:
            for side in (0, 1):
                here = free[index : index + stretch.stop - stretch.start, side]
                for low, high in runs(here, gap=1) if here.any() else ():
                    if high - low > 3:
                        yield stretch, side, first, float(stretch.start + low), float(stretch.start + high)
            index += stretch.stop - stretch.start
        first += len(street.middle)


def _free(network: Network) -> Bool[np.ndarray, "n 2"]:
    """Whether the edge of the plots beside each street point is clear of all other streets, left and right."""
    left = np.stack([-np.sin(network.heading), np.cos(network.heading)], axis=1)
    sides = []
    for column, sign in ((0, 1), (1, -1)):
        edge = network.middle + sign * (network.half_width + network.verge[:, column] + 0.5)[:, None] * left
        sides.append(_margin(network, edge, whole_street=np.ones(len(edge), bool)) >= -0.1)
    return np.stack(sides, axis=1)


def _margin(network: Network, xy: np.ndarray, whole_street: np.ndarray) -> np.ndarray:
    """Distance of each position outside the nearest road, or outside its strips where `whole_street` is true."""
    nearest = network.nearest(xy)
    offset = network.offset(xy, nearest)
    verge = network.verge[nearest, (offset < 0).astype(int)]
    return np.abs(offset) - network.half_width[nearest] - verge * whole_street


def _parts(placed: list[Placed]) -> tuple[np.ndarray, list[Part]]:
    """Index of the thing of each part, and all parts of all things."""
    thing = np.repeat(np.arange(len(placed)), [len(item.thing) for item in placed])
    return thing, [part for item in placed for part in item.thing]


def _anchors(
    network: Network, along: np.ndarray, side: np.ndarray, across: np.ndarray, placed: list[Placed], thing: np.ndarray
) -> Anchors:
    whole = along.astype(int).clip(0, len(network.middle) - 1)
    rest = along - whole
    heading = network.heading[whole]
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    xy = network.middle[whole] + rest[:, None] * ahead + (side * across)[:, None] * left
    yaw, since, until = np.array([(item.yaw, item.since, item.until) for item in placed]).reshape(-1, 3).T
    return Anchors(*(column[thing] for column in (xy, heading + side * yaw, side, since, until)))


def _on_a_street(
    network: Network, shapes: Shapes, street: np.ndarray, zone: np.ndarray, bottom: np.ndarray
) -> Bool[np.ndarray, " n"]:
    """Whether each shape touches a road, or strips that it belongs behind. Cars must park on their own street."""
    bad = np.zeros(len(zone), bool)
    cos, sin = np.cos(shapes.yaw), np.sin(shapes.yaw)
    for u in np.linspace(-1, 1, 7):
        for v in np.linspace(-1, 1, 5):
            x, y = u * shapes.half[:, 0], v * shapes.half[:, 1]
            xy = np.asarray(shapes.centre)[:, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)
            bad |= _margin(network, xy, zone == "plot") < -_TOLERANCE_M
            bad |= (zone == "bay") & (network.street[network.nearest(xy)] != street)
    return bad & (bottom < _HEAD_ROOM_M)


def _in_the_way(shapes: Shapes, path: Float[np.ndarray, "p 2"]) -> Bool[np.ndarray, " n"]:
    """Whether each shape is closer to the vehicle's path than CLEARANCE_M."""
    dense = np.concatenate([path, (path[1:] + path[:-1]) / 2])
    reach = np.hypot(shapes.half[:, 0], shapes.half[:, 1]) + CLEARANCE_M
    near = KDTree(dense).query_ball_point(shapes.centre[:, :2], reach)
    row = np.repeat(np.arange(len(near)), [len(indices) for indices in near])
    away = dense[np.concatenate([np.zeros(0), *near]).astype(int)] - shapes.centre[row, :2]
    distance = footprint_distance(away, np.asarray(shapes.yaw)[row], np.asarray(shapes.half)[row])
    bad = np.zeros(len(near), bool)
    bad[row[distance < CLEARANCE_M + 0.05]] = True
    return bad


def footprint_distance(
    away: Float[np.ndarray, "n 2"], yaw: Float[np.ndarray, " n"], half: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Distance from the rectangle of half sizes `half`, rotated by `yaw`, to the point `away` from its centre."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    along, across = cos * away[:, 0] + sin * away[:, 1], cos * away[:, 1] - sin * away[:, 0]
    outside = np.stack([np.abs(along) - half[:, 0], np.abs(across) - half[:, 1]], axis=1)
    return np.linalg.norm(np.maximum(outside, 0), axis=1)


def _on_an_island(shapes: Shapes, islands: tuple[Island, ...]) -> Bool[np.ndarray, " n"]:
    """Whether each shape is inside a roundabout."""
    bad = np.zeros(len(shapes.label), bool)
    for island in islands:
        away = np.linalg.norm(shapes.centre[:, :2] - island.centre, axis=1)
        bad |= away < island.radius + 2 + np.hypot(shapes.half[:, 0], shapes.half[:, 1])
    return bad


def plant_islands(
    rng: np.random.Generator, islands: tuple[Island, ...], ground: Ground, make: Callable
) -> tuple[Shapes, list[Part]]:
    """Places a thing drawn by `make` in the middle of each roundabout.

    Returns the shapes, and the part that each shape belongs to.
    """
    things = [make(rng) for _ in islands]
    owner = np.repeat(np.arange(len(things)), [len(thing) for thing in things])
    centre = np.array([island.centre for island in islands]).reshape(-1, 2)[owner]
    count = len(owner)
    always = np.full(count, -np.inf), np.full(count, np.inf)
    parts = [part for thing in things for part in thing]
    return place(parts, Anchors(centre, np.zeros(count), np.ones(count), *always), ground), parts
