"""Objects with their poses in the world, their conversion to shapes, and distances between shapes and a path."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from sglpr_jax.sim.ground import Ground, surface_height
from sglpr_jax.sim.objects import KINDS, ObjectModel, Primitive
from sglpr_jax.sim.shapes import Scene, Shapes

CLEARANCE_M = 1.6  # minimum distance of standing objects from the vehicle's path, in metres
HEAD_ROOM_M = 2.0  # minimum height of parts above the vehicle, a street or its sidewalk, in metres

Zone = Literal["bay", "verge", "plot"]
"""Where an object stands: parked along its street, on the strips beside the road, or behind the strips."""


class Spot(NamedTuple):
    """Object and its pose in the world. If `side` is -1, its y axis is mirrored."""

    thing: ObjectModel
    x: float  # metres, at `time`
    y: float
    heading: float = 0.0  # radians
    side: int = 1
    velocity: tuple[float, float] = (0.0, 0.0)  # m/s
    since: float = -np.inf  # seconds; the object is present for since <= time < until
    until: float = np.inf  # seconds
    time: float = 0.0  # seconds
    zone: Zone = "plot"


def moving_spots(
    thing: ObjectModel,
    begin: Float[np.ndarray, "n 2"],
    end: Float[np.ndarray, "n 2"],
    heading: Float[np.ndarray, " n"],
    since: Float[np.ndarray, " n"],
    until: Float[np.ndarray, " n"],
) -> list[Spot]:
    """Straight motions of `thing` from `begin` to `end`, on the ground in the middle between them."""
    velocity = (end - begin) / (until - since)[:, None]
    rows = np.column_stack([(begin + end) / 2, heading, velocity, since, until, (since + until) / 2]).tolist()
    return [
        Spot(thing, x, y, turn, velocity=(vx, vy), since=since, until=until, time=time)
        for x, y, turn, vx, vy, since, until, time in rows
    ]


class PlacedObjects(NamedTuple):
    """Shapes of all parts of all objects, one row per part."""

    shapes: Shapes
    parts: list[Primitive]
    owner: np.ndarray  # (n,) index of the spot of each part


def place(spots: Sequence[Spot], ground: Ground) -> PlacedObjects:
    """Converts objects to shapes in the world. Objects stand on the ground at x and y."""
    parts = [part for spot in spots for part in spot.thing]
    owner = np.repeat(np.arange(len(spots)), [len(spot.thing) for spot in spots])
    # Columns: x, y, heading, side, velocity x and y, since, until, time. One row per part.
    spot_rows = [(*spot[1:5], *spot.velocity, spot.since, spot.until, spot.time) for spot in spots]
    spot_table = np.array(spot_rows, np.float64).reshape(-1, 9)[owner]
    anchor, velocity = spot_table[:, :2], spot_table[:, 4:6]
    heading, side, since, until, time = spot_table[:, [2, 3, 6, 7, 8]].T
    part_rows = [(*part.size, *part[3:]) for part in parts]  # size, then the fields from x to glass
    size, part_fields = np.split(np.array(part_rows).reshape(-1, 10).T, [3])
    x, y, bottom, yaw, roughness, porosity, glass = part_fields
    cos, sin, left = np.cos(heading), np.sin(heading), side * y
    xy_at_time = anchor + np.stack([cos * x - sin * left, sin * x + cos * left], axis=1)
    xy = xy_at_time - velocity * time[:, None]  # shapes hold positions at time 0
    z = surface_height(ground, anchor) + bottom + size[2] / 2
    shapes = Shapes(
        centre=np.concatenate([xy, z[:, None]], axis=1),
        half=size.T / 2,
        yaw=heading + side * yaw,
        label=np.array([part.label for part in parts], dtype=np.int32),
        roughness=roughness,
        porosity=porosity,
        glass=glass,
        velocity=velocity,
        since=since,
        until=until,
    )
    return PlacedObjects(shapes, parts, owner)


def to_scene(placed: PlacedObjects, keep: np.ndarray) -> Scene:
    """Scene of the shapes in `placed` whose row in `keep` is true."""
    kinds = np.array([part.kind for part in placed.parts])
    return Scene(*(Shapes(*(column[keep & (kinds == kind)] for column in placed.shapes)) for kind in KINDS))


def footprint_distance(
    offset: Float[np.ndarray, "n 2"], yaw: Float[np.ndarray, " n"], half: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Distance in metres from each rectangle to a point at `offset` from its centre, or 0 inside the rectangle.

    A rectangle has the half sizes `half` (z is not used) and is rotated by `yaw`.
    """
    cos, sin = np.cos(yaw), np.sin(yaw)
    along, across = cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0]
    outside = np.stack([np.abs(along) - half[:, 0], np.abs(across) - half[:, 1]], axis=1)
    return np.linalg.norm(np.maximum(outside, 0), axis=1)


def distances(shapes: Shapes, line: Float[np.ndarray, "p 2"], *, reach_m: float) -> Float[np.ndarray, " n"]:
    """Horizontal distance of each shape from the nearest point of a line, in metres. It may be inf above `reach_m`."""
    search_radius = np.hypot(shapes.half[:, 0], shapes.half[:, 1]) + reach_m
    near_points = KDTree(line).query_ball_point(np.asarray(shapes.centre)[:, :2], search_radius)
    # One row for each pair of a shape and a point near it.
    shape_row = np.repeat(np.arange(len(near_points)), [len(points) for points in near_points])
    line_row = np.concatenate([np.zeros(0), *near_points]).astype(int)
    offset = line[line_row] - shapes.centre[shape_row, :2]
    pair_distance = footprint_distance(offset, np.asarray(shapes.yaw)[shape_row], np.asarray(shapes.half)[shape_row])
    distance = np.full(len(near_points), np.inf)
    np.minimum.at(distance, shape_row, pair_distance)
    return distance
