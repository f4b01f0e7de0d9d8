"""Things with their poses in the world, their conversion to shapes, and distances between shapes and a path."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from sglpr_jax.sim.ground import Ground, surface_height
from sglpr_jax.sim.objects import KINDS, ObjectModel, Primitive
from sglpr_jax.sim.shapes import Scene, Shapes

CLEARANCE_M = 1.6  # minimum distance of standing things from the vehicle's path, in metres
HEAD_ROOM_M = 2.0  # minimum height of parts above the vehicle, a street or its sidewalk, in metres

Zone = Literal["bay", "verge", "plot"]
"""Place of a thing: parked along its street, on the strips beside the road, or behind the strips."""


class Spot(NamedTuple):
    """Thing and its pose in the world. If `side` is -1, its y axis is mirrored."""

    thing: ObjectModel
    x: float  # metres, at `time`
    y: float
    heading: float = 0.0  # radians
    side: int = 1
    velocity: tuple[float, float] = (0.0, 0.0)  # m/s
    since: float = -np.inf  # seconds
    until: float = np.inf  # seconds
    time: float = 0.0  # seconds
    zone: Zone = "plot"


class PlacedObjects(NamedTuple):
    """Shapes of all parts of all things, one row per part."""

    shapes: Shapes
    parts: list[Primitive]
    owner: np.ndarray  # (n,) index of the spot of each part


def place(spots: Sequence[Spot], ground: Ground) -> PlacedObjects:
    """Converts things to shapes in the world. Things stand on the ground at x and y."""
    parts = [part for spot in spots for part in spot.thing]
    owner = np.repeat(np.arange(len(spots)), [len(spot.thing) for spot in spots])
    numbers = [(*spot[1:5], *spot.velocity, spot.since, spot.until, spot.time) for spot in spots]
    poses = np.array(numbers, np.float64).reshape(-1, 9)[owner]
    anchor, velocity, (heading, side, since, until, time) = poses[:, :2], poses[:, 4:6], poses[:, [2, 3, 6, 7, 8]].T
    numbers = [(*part.size, *part[3:]) for part in parts]  # from x to glass
    size, (x, y, bottom, yaw, roughness, porosity, glass) = np.split(np.array(numbers).reshape(-1, 10).T, [3])
    cos, sin, across = np.cos(heading), np.sin(heading), side * y
    xy = anchor + np.stack([cos * x - sin * across, sin * x + cos * across], axis=1) - velocity * time[:, None]
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
    """Boxes, cylinders and ellipsoids among the rows of `placed` where `keep` is true."""
    kinds = np.array([part.kind for part in placed.parts])
    return Scene(*(Shapes(*(leaf[keep & (kinds == kind)] for leaf in placed.shapes)) for kind in KINDS))


def footprint_distance(
    away: Float[np.ndarray, "n 2"], yaw: Float[np.ndarray, " n"], half: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Distance from the rectangle of half sizes `half`, rotated by `yaw`, to the point `away` from its centre."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    along, across = cos * away[:, 0] + sin * away[:, 1], cos * away[:, 1] - sin * away[:, 0]
    outside = np.stack([np.abs(along) - half[:, 0], np.abs(across) - half[:, 1]], axis=1)
    return np.linalg.norm(np.maximum(outside, 0), axis=1)


def distances(shapes: Shapes, line: Float[np.ndarray, "p 2"], *, reach_m: float) -> Float[np.ndarray, " n"]:
    """Horizontal distance of each shape from the points of a line, in metres. Farther than `reach_m` it may be inf."""
    reach = np.hypot(shapes.half[:, 0], shapes.half[:, 1]) + reach_m
    near = KDTree(line).query_ball_point(np.asarray(shapes.centre)[:, :2], reach)
    row = np.repeat(np.arange(len(near)), [len(indices) for indices in near])
    away = line[np.concatenate([np.zeros(0), *near]).astype(int)] - shapes.centre[row, :2]
    distance = np.full(len(near), np.inf)
    np.minimum.at(distance, row, footprint_distance(away, np.asarray(shapes.yaw)[row], np.asarray(shapes.half)[row]))
    return distance
