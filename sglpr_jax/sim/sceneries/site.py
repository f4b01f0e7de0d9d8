"""Elements of a scenery: lines, objects along them and in rows, walls and ground, and construction of the world."""

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d

from sglpr_jax.se3 import lengths_along
from sglpr_jax.sim.drive import shifted, waves
from sglpr_jax.sim.ground import CELL_M, Ground, Relief, draw_relief
from sglpr_jax.sim.labels import BUILDING, OTHER_GROUND, TERRAIN
from sglpr_jax.sim.objects import ObjectModel, Primitive, block
from sglpr_jax.sim.placement import HEAD_ROOM_M, Spot, distances, place, to_scene
from sglpr_jax.sim.routes import Line, Revisit, resampled
from sglpr_jax.sim.world import Levels, World

STEP_M = 0.1  # distance between two points of a line, in metres
MARGIN_M = 90.0  # length of a road beyond both ends of a drive, in metres, which hides the ends of the road
LAPS = 1.5  # number of laps along a closed line for revisits in the same direction
FLAT = Relief(np.zeros(4), np.full((4, 2), 0.01), np.zeros(4))  # four waves of amplitude 0
WALL_M = 0.3  # thickness of walls, in metres
_RASTER_MARGIN_M = 30.0  # distance of the edge of painted ground from its lines, in metres


class Site(NamedTuple):
    """Scenery: the driven line, the objects around it, and the ground."""

    line: Line
    spots: list[Spot]
    ground: Ground
    levels: Levels | None = None
    """Storeys above one another. `line` has true positions, and `spots` are in the world with storeys side by side."""
    returns: bool = False  # whether `line` has revisits in the same direction, so that it needs no second lap


class PaintedStrip(NamedTuple):
    """Strip of ground between two distances to the left of a line, in metres."""

    line: Line
    low_m: float
    high_m: float
    label: int
    dash_m: float | None = None  # length of dashes and gaps


def along(line: Line, *things: tuple[ObjectModel, float]) -> list[Spot]:
    """Places objects along a line, with their x axes along the line. `things` are pairs of object and spacing (m)."""
    spots, directions = [], np.gradient(line, axis=0)
    for thing, every_m in things:
        rows = np.arange(0, len(line) - 1, every_m / STEP_M).astype(int)
        headings = np.arctan2(*directions[rows].T[::-1])
        poses = np.column_stack([line[rows], headings]).tolist()
        spots += [Spot(thing, x, y, heading) for x, y, heading in poses]
    return spots


def grid(xs: Iterable[float], ys: Iterable[float], make: Callable[[], ObjectModel]) -> list[Spot]:
    """Places an object from `make` at each combination of x and y."""
    return [Spot(make(), float(x), float(y)) for x, y in itertools.product(xs, ys)]


def on_both_sides(
    xs: Iterable[float],
    line_ys: Float[np.ndarray, " _"],
    offset_m: float,
    make: Callable[[], ObjectModel],
    heading: float = 0.0,
) -> list[Spot]:
    """Places objects `offset_m` to the left of lines along x, at all `xs`, then mirrored ones to the right."""
    return [
        spot._replace(heading=0.0 + side * heading, side=side)  # never -0.0
        for side in (1, -1)
        for spot in grid(xs, line_ys + side * offset_m, make)
    ]


def mirrored(*parts: Primitive) -> ObjectModel:
    """Parts and their mirror images on the other side of the x axis."""
    return *parts, *(part._replace(y=-part.y) for part in parts)


def jittered(rng: np.random.Generator, spots: list[Spot], metres: float, *, keep: float = 1.0) -> list[Spot]:
    """Keeps a random fraction `keep` of the spots, shifts them by about `metres`, and turns them by up to 3 degrees."""
    spots = [spot for spot in spots if rng.random() < keep]
    moves = rng.normal(scale=metres, size=(len(spots), 2)).tolist()
    turns = np.radians(rng.uniform(-3, 3, len(spots))).tolist()
    return [
        spot._replace(x=spot.x + dx, y=spot.y + dy, heading=spot.heading + turn)
        for spot, (dx, dy), turn in zip(spots, moves, turns, strict=True)
    ]


def rolling(rng: np.random.Generator) -> Relief:
    """Gentle hills with slopes of at most 1.5 %."""
    return draw_relief(rng, steepest=0.015)


def painted_ground(base: int, strips: Sequence[PaintedStrip] = (), relief: Relief = FLAT) -> Ground:
    """Ground of label `base` with painted strips. Later strips cover earlier strips."""
    if not strips:  # one cell, whose label repeats everywhere
        return Ground(np.full((1, 1), base, np.uint8), np.zeros(2), relief)
    points = np.concatenate([strip.line for strip in strips])
    origin, size = points.min(axis=0) - _RASTER_MARGIN_M, np.ptp(points, axis=0) + 2 * _RASTER_MARGIN_M
    raster = np.full(np.ceil(size / CELL_M).astype(int)[::-1] + 1, base, np.uint8)
    for strip in strips:
        line = strip.line
        if strip.dash_m is not None:
            line = line[np.arange(len(line)) * STEP_M // strip.dash_m % 2 == 0]
        for left_m in np.arange(strip.low_m, strip.high_m, CELL_M / 2):
            column, row = ((shifted(line, left_m) - origin) / CELL_M).astype(int).T
            raster[row, column] = strip.label
    return Ground(raster, origin, relief)


def track(line: Line, half_m: float, relief: Relief) -> Ground:
    """Terrain with an unpaved track of half width `half_m` along a line."""
    return painted_ground(TERRAIN, [PaintedStrip(line, -half_m, half_m, OTHER_GROUND)], relief)


def wall(start: tuple[float, float], stop: tuple[float, float], height_m: float) -> Primitive:
    """Wall of a building along x or y."""
    length, width = (abs(b - a) + WALL_M for a, b in zip(start, stop, strict=True))
    return block(BUILDING, length, width, height_m, (start[0] + stop[0]) / 2, (start[1] + stop[1]) / 2, roughness=0.02)


def closed_box(min_x: float, max_x: float, min_y: float, max_y: float, height_m: float) -> ObjectModel:
    """Four outer walls of a building and its ceiling."""
    corners = [(min_x, min_y), (max_x, min_y), (max_x, max_y), (min_x, max_y)]
    x, y = (min_x + max_x) / 2, (min_y + max_y) / 2
    ceiling = block(BUILDING, max_x - min_x, max_y - min_y, 0.3, x, y, bottom=height_m, roughness=0.02)
    return *(wall(corners[i - 1], corners[i], height_m) for i in range(4)), ceiling


def build(site: Site, driven: Line, *, clearance_m: float) -> World:
    """Builds the world of a site without standing objects closer than `clearance_m` to the driven line."""
    placed = place(site.spots, site.ground)
    driven = driven if site.levels is None else site.levels.along(driven)[0]
    is_low = np.array([part.bottom < HEAD_ROOM_M for part in placed.parts]) & ~placed.shapes.velocity.any(axis=1)
    is_close = is_low & (distances(placed.shapes, driven, reach_m=clearance_m) < clearance_m)
    scene = to_scene(placed, ~np.isin(placed.owner, placed.owner[is_close]))
    return World(scene, site.ground, site.levels)


class Rows(NamedTuple):
    """Driven line through `count` parallel rows along x, each from x = 0 to `run_m` metres, at equal distances in y."""

    line: Line
    count: int
    run_m: float


def road(rng: np.random.Generator, length_m: float, closed: bool) -> tuple[Line, Line]:
    """Draws a road. Returns its line and the driven part, whose length is `length_m`.

    A closed road has two straight lines and two half circles, and is driven completely. Other roads are a straight line
    or an arc, and extend MARGIN_M beyond both ends of the driven part.
    """
    if closed:
        straight_fraction = rng.uniform(0, 0.5)
        straight_points = round(length_m * straight_fraction / 2 / STEP_M)
        arc_points = round(length_m * (1 - straight_fraction) / 2 / STEP_M)
        arc_curvature = np.pi / (arc_points * STEP_M)
        line = _line_from_curvature(np.tile(np.repeat([0.0, arc_curvature], [straight_points, arc_points]), 2))
        return line, line
    angle = rng.choice((0.0, rng.uniform(-2.5, 2.5)))
    line = _line_from_curvature(np.full(round((length_m + 2 * MARGIN_M) / STEP_M), angle / length_m))
    margin_points = round(MARGIN_M / STEP_M)
    return line, line[margin_points:-margin_points]


def _line_from_curvature(curvature: Float[np.ndarray, " n"]) -> Line:
    """Line that starts at the origin along x, with the given curvature (1 / metres) at each point."""
    heading = np.cumsum(curvature) * STEP_M
    return np.cumsum(STEP_M * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)


def rounded(corners: ArrayLike, *, corner_m: float, closed: bool = False, length_m: float | None = None) -> Line:
    """Line through the polygon `corners`, smoothed by a Gaussian with the standard deviation `corner_m`.

    An open line ends after `length_m` metres, if given.
    """
    polygon = np.asarray(corners)
    if closed:
        points = resampled(np.concatenate([polygon, polygon[:1]]), STEP_M)[:-1]
        return resampled(gaussian_filter1d(points, corner_m / STEP_M, axis=0, mode="wrap"), STEP_M)
    points = resampled(polygon, STEP_M)
    line = resampled(gaussian_filter1d(points, corner_m / STEP_M, axis=0, mode="nearest"), STEP_M)
    return line if length_m is None else line[: round(length_m / STEP_M)]


def rows(length_m: float, *, run_m: float, pitch_m: float, closed: bool, back_m: float, corner_m: float) -> Rows:
    """Path back and forth through parallel rows, `length_m` long, with corners rounded by `corner_m`.

    A row is `run_m` long (about, if closed), and rows are `pitch_m` apart. A closed path returns at x = -`back_m`.
    """
    if closed:
        count = 2 * max(1, round((length_m - 2 * back_m) / (run_m + 2 * pitch_m) / 2))
        run_m = (length_m - 2 * back_m - 2 * (count - 1) * pitch_m) / count
    else:
        count = int(np.ceil(length_m / (run_m + pitch_m))) + 1
    corners = []
    for k in range(count):
        start_x, end_x = (0.0, run_m) if k % 2 == 0 else (run_m, 0.0)
        corners += [(start_x, k * pitch_m), (end_x, k * pitch_m)]
    if closed:
        corners += [(-back_m, corners[-1][1]), (-back_m, 0.0)]
    return Rows(rounded(corners, corner_m=corner_m, closed=closed, length_m=length_m), count, run_m)


def driven_line(rng: np.random.Generator, site: Site, revisit: Revisit, *, right_m: float, sway_m: float) -> Line:
    """Path of a vehicle `right_m` metres to the right of a site's line, with a sway of up to `sway_m` metres.

    For the revisit "opposite", the path returns along the line. For "same", it has LAPS laps of the closed line.
    """
    line = site.line
    if revisit == "same" and not site.returns:
        line = np.concatenate([line, line[: round((LAPS - 1) * len(line))]])
    path = shifted(line, -right_m)
    if revisit == "opposite":  # a half circle to the left around the end of the line, and back
        forward = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
        left = np.array([-forward[1], forward[0]])
        angle = np.linspace(-np.pi / 2, np.pi / 2, 2 + round(np.pi * right_m / STEP_M))[1:-1, None]
        half_circle = line[-1] + right_m * (np.cos(angle) * forward + np.sin(angle) * left)
        path = np.concatenate([path, half_circle, shifted(line[::-1], -right_m)])
    path = resampled(path, STEP_M)
    return resampled(shifted(path, sway_m * waves(rng, lengths_along(path), (15.0, 60.0))), STEP_M)
