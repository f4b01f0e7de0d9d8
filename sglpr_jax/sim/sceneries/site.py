"""Elements of a scenery: lines, things along them and in rows, walls and ground, and construction of the world."""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d

from sglpr_jax.sim.drive import shifted, waves
from sglpr_jax.sim.ground import CELL_M, Ground, Relief, draw_relief
from sglpr_jax.sim.labels import BUILDING, OTHER_GROUND, TERRAIN
from sglpr_jax.sim.objects import ObjectModel, Primitive, block
from sglpr_jax.sim.placement import HEAD_ROOM_M, Spot, distances, place, to_scene
from sglpr_jax.sim.routes import Line, Revisit, resampled, travelled
from sglpr_jax.sim.styles import TOWN
from sglpr_jax.sim.world import Levels, World

STEP_M = 0.1  # distance between two points of a line, in metres
MARGIN_M = 90.0  # length of a road beyond both ends of a drive, in metres, which hides the ends of the road
LAPS = 1.5  # number of laps along a closed line for revisits in the same direction
FLAT = Relief(np.zeros(4), np.full((4, 2), 0.01), np.zeros(4))
WALL_M = 0.3  # thickness of walls, in metres
_AROUND_M = 30.0


class Site(NamedTuple):
    """Scenery: the driven line, the things around it, and the ground."""

    line: Line
    spots: list[Spot]
    ground: Ground
    levels: Levels | None = None
    """Storeys above one another. `line` lies in them, and `spots` in the world that holds them side by side."""
    returns: bool = False  # whether the line itself returns to its places, for revisits in the same direction


class Strip(NamedTuple):
    """Strip of ground between two distances to the left of a line, in metres."""

    line: Line
    low_m: float
    high_m: float
    label: int
    dash_m: float | None = None  # length of dashes and gaps


def along(line: Line, *things: tuple[ObjectModel, float]) -> list[Spot]:
    """Places each thing along a line, with its x axis along the line, at equal distances in metres."""
    spots, directions = [], np.gradient(line, axis=0)
    for thing, every_m in things:
        rows = np.arange(0, len(line) - 1, every_m / STEP_M).astype(int)
        headings = np.arctan2(*directions[rows].T[::-1])
        spots += [Spot(thing, *place) for place in np.column_stack([line[rows], headings]).tolist()]
    return spots


def grid(xs: Iterable[float], ys: Iterable[float], make: Callable[[], ObjectModel]) -> list[Spot]:
    """Places a thing at each combination of x and y."""
    return [Spot(make(), float(x), float(y)) for x, y in itertools.product(xs, ys)]


def on_both_sides(
    xs: Iterable[float],
    lines: Float[np.ndarray, " _"],
    away_m: float,
    make: Callable[[], ObjectModel],
    heading: float = 0.0,
) -> list[Spot]:
    """Places things on the left of all lines along x, at their y, then mirrored things on the right."""
    return [
        spot._replace(heading=0.0 + side * heading, side=side)  # never -0.0
        for side in (1, -1)
        for spot in grid(xs, lines + side * away_m, make)
    ]


def mirrored(*parts: Primitive) -> ObjectModel:
    """Parts and their mirror images on the other side of the x axis."""
    return *parts, *(part._replace(y=-part.y) for part in parts)


def jittered(rng: np.random.Generator, spots: list[Spot], metres: float, *, keep: float = 1.0) -> list[Spot]:
    """Keeps the fraction `keep` of the spots, shifts them by about `metres`, and turns them by up to 3 degrees."""
    spots = [spot for spot in spots if rng.random() < keep]
    moves = rng.normal(scale=metres, size=(len(spots), 2)).tolist()
    turns = np.radians(rng.uniform(-3, 3, len(spots))).tolist()
    return [
        spot._replace(x=spot.x + dx, y=spot.y + dy, heading=spot.heading + turn)
        for spot, (dx, dy), turn in zip(spots, moves, turns, strict=True)
    ]


def rolling(rng: np.random.Generator) -> Relief:
    """Gentle hills with slopes of at most 1.5 %."""
    return draw_relief(rng, dataclasses.replace(TOWN, steepest=0.015))


def painted_ground(base: int, strips: Sequence[Strip] = (), relief: Relief = FLAT) -> Ground:
    """Ground of label `base` with painted strips. Later strips cover earlier strips."""
    if not strips:
        return Ground(np.full((1, 1), base, np.uint8), np.zeros(2), relief)
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


def track(line: Line, half_m: float, relief: Relief) -> Ground:
    """Terrain with an unpaved track of half width `half_m` along a line."""
    return painted_ground(TERRAIN, [Strip(line, -half_m, half_m, OTHER_GROUND)], relief)


def wall(start: tuple[float, float], stop: tuple[float, float], height_m: float) -> Primitive:
    """Wall of a building along x or y."""
    length, width = (abs(b - a) + WALL_M for a, b in zip(start, stop, strict=True))
    return block(BUILDING, length, width, height_m, (start[0] + stop[0]) / 2, (start[1] + stop[1]) / 2, roughness=0.02)


def closed_box(left: float, right: float, low: float, high: float, height_m: float) -> ObjectModel:
    """Four outer walls of a building and its ceiling."""
    corners = [(left, low), (right, low), (right, high), (left, high)]
    x, y = (left + right) / 2, (low + high) / 2
    ceiling = block(BUILDING, right - left, high - low, 0.3, x, y, bottom=height_m, roughness=0.02)
    return *(wall(corners[i - 1], corners[i], height_m) for i in range(4)), ceiling


def build(site: Site, driven: Line, *, clearance_m: float) -> World:
    """Builds the world of a site without standing things closer than `clearance_m` to the driven line."""
    placed = place(site.spots, site.ground)
    driven = driven if site.levels is None else site.levels.along(driven)[0]
    is_low = np.array([part.bottom < HEAD_ROOM_M for part in placed.parts]) & ~placed.shapes.velocity.any(axis=1)
    is_close = is_low & (distances(placed.shapes, driven, reach_m=clearance_m) < clearance_m)
    scene = to_scene(placed, ~np.isin(placed.owner, placed.owner[is_close]))
    return World(scene, site.ground, site.levels)


class Rows(NamedTuple):
    """Path through parallel rows along x. Row k is at y = k * pitch, from x = 0 to `run_m`."""

    line: Line
    count: int
    run_m: float


def road(rng: np.random.Generator, length_m: float, closed: bool) -> tuple[Line, Line]:
    """Road and its driven part: a line or an arc with MARGIN_M at both ends, or two lines and two half circles."""
    if closed:
        straight = rng.uniform(0, 0.5)
        count = round(length_m * straight / 2 / STEP_M), round(length_m * (1 - straight) / 2 / STEP_M)
        line = _integrated(np.tile(np.repeat([0.0, np.pi / (count[1] * STEP_M)], count), 2))
        return line, line
    turn = rng.choice((0.0, rng.uniform(-2.5, 2.5)))
    line = _integrated(np.full(round((length_m + 2 * MARGIN_M) / STEP_M), turn / length_m))
    margin = round(MARGIN_M / STEP_M)
    return line, line[margin:-margin]


def _integrated(curvature: Float[np.ndarray, " n"]) -> Line:
    """Line that starts at the origin along x, with the given curvature (1 / metres) at each point."""
    heading = np.cumsum(curvature) * STEP_M
    return np.cumsum(STEP_M * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)


def rounded(corners: ArrayLike, *, corner_m: float, closed: bool = False, length_m: float | None = None) -> Line:
    """Polygon through `corners`, rounded by a Gaussian of `corner_m`. An open one ends after `length_m` metres."""
    polygon = np.asarray(corners)
    polygon = resampled(np.concatenate([polygon, polygon[:1]]), STEP_M)[:-1] if closed else resampled(polygon, STEP_M)
    line = gaussian_filter1d(polygon, corner_m / STEP_M, axis=0, mode="wrap" if closed else "nearest")
    return resampled(line, STEP_M)[: None if closed or length_m is None else round(length_m / STEP_M)]


def rows(length_m: float, *, run_m: float, pitch_m: float, closed: bool, back_m: float, corner_m: float) -> Rows:
    """Path of about `length_m` metres through rows of about `run_m` metres. If closed, it returns at x = -`back_m`."""
    if closed:
        count = 2 * max(1, round((length_m - 2 * back_m) / (run_m + 2 * pitch_m) / 2))
        run_m = (length_m - 2 * back_m - 2 * (count - 1) * pitch_m) / count
    else:
        count = int(np.ceil(length_m / (run_m + pitch_m))) + 1
    ends = [(x, k * pitch_m) for k in range(count) for x in ((0.0, run_m), (run_m, 0.0))[k % 2]]
    return_path = [(-back_m, ends[-1][1]), (-back_m, 0.0)] * closed
    return Rows(rounded([*ends, *return_path], corner_m=corner_m, closed=closed, length_m=length_m), count, run_m)


def driven_line(rng: np.random.Generator, site: Site, revisit: Revisit, *, right_m: float, sway_m: float) -> Line:
    """Path of a vehicle `right_m` metres to the right of a site's line, with a sway of up to `sway_m` metres.

    Revisits are on the way back ("opposite"), or in LAPS laps of a closed line ("same").
    """
    line = site.line
    if revisit == "same" and not site.returns:
        line = np.concatenate([line, line[: round((LAPS - 1) * len(line))]])
    path = shifted(line, -right_m)
    if revisit == "opposite":  # a half circle to the left around the end of the line, and back
        ahead = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
        angle = np.linspace(-np.pi / 2, np.pi / 2, 2 + round(np.pi * right_m / STEP_M))[1:-1, None]
        turn = line[-1] + right_m * (np.cos(angle) * ahead + np.sin(angle) * np.array([-ahead[1], ahead[0]]))
        path = np.concatenate([path, turn, shifted(line[::-1], -right_m)])
    path = resampled(path, STEP_M)
    return resampled(shifted(path, sway_m * waves(rng, travelled(path), (15.0, 60.0))), STEP_M)
