"""Elements of a scenery, functions that place things in rows and along lines, and construction of the world."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from sglpr_jax.sim.ground import CELL_M, Ground, Relief, draw_relief
from sglpr_jax.sim.levels import Levels
from sglpr_jax.sim.placing import Anchors, footprint_distance, place, select, to_scene
from sglpr_jax.sim.sceneries.ways import STEP_M, Line, shifted
from sglpr_jax.sim.scenery import TOWN
from sglpr_jax.sim.shapes import Shapes
from sglpr_jax.sim.things import Part, Thing
from sglpr_jax.sim.world import World

HEAD_ROOM_M = 2.0
"""Minimum height of parts that may be above the vehicle, in metres."""
FLAT = Relief(np.zeros(4), np.full((4, 2), 0.01), np.zeros(4))
_ROLLING = dataclasses.replace(TOWN, steepest=0.015)
OVERLAP = 1.25
"""Length of a piece of wall divided by the spacing. In curves, the outer wall is longer than the road."""
_AROUND_M = 30.0


class Spot(NamedTuple):
    """Thing and its pose in the world. If `side` is -1, its y axis is mirrored."""

    thing: Thing
    x: float  # metres, at time 0
    y: float
    heading: float = 0.0  # radians
    side: int = 1
    velocity: tuple[float, float] = (0.0, 0.0)  # m/s
    since: float = -np.inf  # seconds
    until: float = np.inf  # seconds


class Site(NamedTuple):
    """Scenery: the driven line, the things around it, and the ground."""

    line: Line
    spots: list[Spot]
    ground: Ground
    levels: Levels | None = None
    """Storeys above one another. `line` lies in them, and `spots` in the world that holds them side by side."""
    returns: bool = False
    """Whether the line itself returns to its places, for revisits in the same direction."""


class Strip(NamedTuple):
    """Strip of ground between two distances to the left of a line, in metres.

    With `dash_m`, the strip is dashed. Dashes and gaps have this length, in metres.
    """

    line: Line
    low_m: float
    high_m: float
    label: int
    dash_m: float | None = None


def block(label: int, length: float, width: float, height: float, x: float = 0.0, y: float = 0.0, **more) -> Part:
    """Box with its centre at x and y. `more` holds fields of Part."""
    return Part("box", label, (length, width, height), x, y, **more)


def post(label: int, thick: float, height: float, x: float = 0.0, y: float = 0.0, **more) -> Part:
    """Cylinder with its axis at x and y. `more` holds fields of Part."""
    return Part("cylinder", label, (thick, thick, height), x, y, **more)


def along(line: Line, make: Callable[[], Thing], every_m: float, *, first_m: float = 0.0) -> list[Spot]:
    """Places things every `every_m` metres along a line, with their x axes along the line."""
    rows = np.arange(first_m / STEP_M, len(line) - 1, every_m / STEP_M).astype(int)
    ahead = np.gradient(line, axis=0)[rows]
    places = zip(*line[rows].T.tolist(), np.arctan2(ahead[:, 1], ahead[:, 0]).tolist(), strict=True)
    return [Spot(make(), x, y, heading) for x, y, heading in places]


def grid(
    xs: Iterable[float], ys: Iterable[float], make: Callable[[], Thing], *, heading: float = 0.0, side: int = 1
) -> list[Spot]:
    """Places a thing at each combination of x and y."""
    ys = list(ys)
    return [Spot(make(), float(x), float(y), heading, side) for x in xs for y in ys]


def jittered(rng: np.random.Generator, spots: list[Spot], metres: float, *, keep: float = 1.0) -> list[Spot]:
    """Keeps the fraction `keep` of the spots, and shifts and rotates them at random.

    The standard deviation of a shift is `metres` along x and y. Rotations are at most 3 degrees.
    """
    kept = [spot for spot in spots if rng.random() < keep]
    moves = rng.normal(scale=metres, size=(len(kept), 2)).tolist()
    turns = np.radians(rng.uniform(-3, 3, len(kept))).tolist()
    return [
        spot._replace(x=spot.x + dx, y=spot.y + dy, heading=spot.heading + turn)
        for spot, (dx, dy), turn in zip(kept, moves, turns, strict=True)
    ]


def rolling(rng: np.random.Generator) -> Relief:
    """Gentle hills with slopes of at most 1.5 %."""
    return draw_relief(rng, _ROLLING)


def even_ground(label: int, relief: Relief = FLAT) -> Ground:
    """Ground with one label everywhere."""
    return Ground(np.full((1, 1), label, np.uint8), np.zeros(2), relief)


def striped_ground(base: int, strips: Sequence[Strip], relief: Relief = FLAT) -> Ground:
    """Ground of label `base` with painted strips. Later strips cover earlier strips."""
    points = np.concatenate([strip.line for strip in strips])
    origin, size = points.min(axis=0) - _AROUND_M, np.ptp(points, axis=0) + 2 * _AROUND_M
    label = np.full(np.ceil(size / CELL_M).astype(int)[::-1] + 1, base, np.uint8)
    for strip in strips:
        line = strip.line
        if strip.dash_m is not None:
            line = line[np.arange(len(line)) * STEP_M // strip.dash_m % 2 == 0]
        for left in np.arange(strip.low_m, strip.high_m, CELL_M / 2):
            column, row = ((shifted(line, left) - origin) / CELL_M).astype(int).T
            label[row, column] = strip.label
    return Ground(label, origin, relief)


def build(site: Site, driven: Line, *, clearance_m: float) -> World:
    """Builds the world of a site without standing things closer than `clearance_m` to the driven line."""
    parts = [part for spot in site.spots for part in spot.thing]
    owner = np.repeat(np.arange(len(site.spots)), [len(spot.thing) for spot in site.spots])
    x, y, heading, side, vx, vy, since, until = np.array(
        [(*spot[1:5], *spot.velocity, spot.since, spot.until) for spot in site.spots]
    )[owner].T
    shapes = place(parts, Anchors(np.stack([x, y], axis=1), heading, side, since, until), site.ground)
    shapes = shapes._replace(velocity=np.stack([vx, vy], axis=1))
    driven = driven if site.levels is None else site.levels.along(driven).xy
    low = np.array([part.bottom < HEAD_ROOM_M for part in parts]) & (vx == 0) & (vy == 0)
    bad = low & (distances(shapes, driven) < clearance_m)
    keep = ~np.isin(owner, owner[bad])
    return World(to_scene(select(shapes, keep), [parts[i] for i in np.flatnonzero(keep)]), site.ground, site.levels)


def distances(shapes: Shapes, line: Line, *, reach_m: float = 3.0) -> Float[np.ndarray, " n"]:
    """Horizontal distance of each shape from a line, in metres. Beyond `reach_m` it is inf."""
    reach = np.hypot(shapes.half[:, 0], shapes.half[:, 1]) + reach_m
    near = KDTree(line).query_ball_point(np.asarray(shapes.centre)[:, :2], reach)
    row = np.repeat(np.arange(len(near)), [len(indices) for indices in near])
    away = line[np.concatenate([np.zeros(0), *near]).astype(int)] - shapes.centre[row, :2]
    distance = np.full(len(near), np.inf)
    np.minimum.at(distance, row, footprint_distance(away, np.asarray(shapes.yaw)[row], np.asarray(shapes.half)[row]))
    return np.where(distance < reach_m, distance, np.inf)
