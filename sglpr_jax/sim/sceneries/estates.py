"""Estates of buildings that repeat: row houses, slabs along parallel streets, and a campus with paths."""

import itertools

import numpy as np

from sglpr_jax.sim.drive import shifted
from sglpr_jax.sim.ground import Ground, Relief
from sglpr_jax.sim.labels import BUILDING, FENCE, OTHER_OBJECT, POLE, ROAD, SIDEWALK, TERRAIN, TRUNK, VEGETATION
from sglpr_jax.sim.objects import House, ObjectModel, ball, bicycle, block, bush, hedge, house, parked, post, tree
from sglpr_jax.sim.placement import Spot
from sglpr_jax.sim.routes import Line
from sglpr_jax.sim.sceneries.site import (
    STEP_M,
    PaintedStrip,
    Site,
    along,
    grid,
    jittered,
    on_both_sides,
    painted_ground,
    rolling,
    rounded,
    rows,
)

ROAD_M = 3.8  # half width of the carriageway, in metres
HOUSES_WALK_M, SLABS_WALK_M = 5.6, 5.8  # half width of the street with its sidewalks, in metres
LAWN_M = 6.0  # minimum distance of a building of the campus from the middle of a path, in metres


def _street(line: Line, walk_m: float, relief: Relief) -> Ground:
    """Ground of a street along a line, with sidewalks up to `walk_m` metres from it."""
    return painted_ground(
        TERRAIN, [PaintedStrip(line, -walk_m, walk_m, SIDEWALK), PaintedStrip(line, -ROAD_M, ROAD_M, ROAD)], relief
    )


def row_houses(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Streets with rows of one house that repeats, 46 to 56 m apart. The cars in front of the houses are different."""
    pitch, width = rng.uniform(46, 56), rng.uniform(5.5, 9)
    plan = rows(length_m, run_m=rng.uniform(110, 160), pitch_m=pitch, closed=closed, back_m=12.0, corner_m=4.0)
    street_ys = pitch * np.arange(-1, plan.count + 1)
    row_house, xs = _row_house(rng, width), np.arange(12.0 + width / 2, plan.run_m - 12.0, width)
    houses = on_both_sides(xs, street_ys, 0.0, lambda: row_house)
    cars = on_both_sides(xs, street_ys, ROAD_M - 0.9, lambda: parked(rng))
    lamp_xs = xs[:: max(1, round(30 / width))] + width / 2  # about 30 m apart
    lamps = grid(lamp_xs, street_ys + ROAD_M + 0.5, lambda: (post(POLE, 0.18, 6.0),))
    ground = _street(plan.line, HOUSES_WALK_M, rolling(rng))
    return Site(plan.line, [*houses, *jittered(rng, cars, 0.2, keep=rng.uniform(0.2, 0.5)), *lamps], ground)


def _row_house(rng: np.random.Generator, width: float) -> ObjectModel:
    """House with its front garden. The origin is in the middle of the street, and y points to the house."""
    garden, depth, height, recess = rng.uniform((3, 8, 5.5, 0.5), (7, 11, 9, 2.5)).tolist()
    front, main_width = HOUSES_WALK_M + garden, rng.choice((1.0, 0.7)) * width
    main_size = (main_width, depth, height + 1)
    body = block(BUILDING, *main_size, 0.0, front + depth / 2, bottom=-1.0, roughness=0.06, glass=0.2)
    wing = block(BUILDING, width, depth - recess, 3.5, 0.0, front + recess + (depth - recess) / 2, bottom=-0.5)
    porch = block(BUILDING, 1.4, 1.2, 2.6, rng.uniform(-0.25, 0.25) * width, front - 0.6)
    shed = block(BUILDING, 2.4, 2.0, 2.3, 0.3 * width, front + depth + rng.uniform(3, 5))
    gate = rng.uniform(1.0, 2.5)
    if rng.random() < 0.5:
        (border,) = hedge(width - gate, rng.uniform(0.4, 0.9), rng.uniform(0.9, 1.6))
    else:
        border = block(FENCE, width - gate, 0.1, rng.uniform(0.8, 1.2), porosity=0.4)
    border = border._replace(x=-gate / 2, y=HOUSES_WALK_M + 0.4)
    side_fence = block(FENCE, 0.1, garden - 0.6, 1.0, width / 2, HOUSES_WALK_M + garden / 2, porosity=0.3)
    x, y = rng.uniform(-0.3, 0.3) * width, front - garden / 2  # tree in the garden
    crown_size = rng.uniform(1.5, 2.5)
    crown = ball(VEGETATION, crown_size, crown_size, x, y, bottom=1.3, roughness=0.6, porosity=0.5)
    return body, wing, porch, shed, border, side_fence, post(TRUNK, 0.15, 2.0, x, y), crown


def slabs(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Streets 44 to 56 m apart with random trees and cars. Between two streets, equal slabs stand in a row."""
    pitch, length, depth, height, gap = rng.uniform((44, 40, 11, 14, 12), (56, 60, 13, 26, 22)).tolist()
    plan = rows(length_m, run_m=2 * (length + gap), pitch_m=pitch, closed=closed, back_m=12.0, corner_m=4.0)
    street_ys = pitch * np.arange(-1, plan.count + 1)
    slab, slab_xs = _slab(length, depth, height), np.arange(gap / 2 + length / 2, plan.run_m, length + gap)
    buildings = grid(slab_xs, street_ys + pitch / 2, lambda: slab)
    car_xs, parking_offset = np.arange(10.0, plan.run_m - 10.0, 6.0), ROAD_M - 0.9
    car_ys = np.concatenate([street_ys - parking_offset, street_ys + parking_offset])
    cars = grid(car_xs, car_ys, lambda: parked(rng))
    lamps = grid(car_xs[::5], street_ys + ROAD_M + 0.5, lambda: (post(POLE, 0.18, 7.0),))
    spots = [*buildings, *jittered(rng, cars, 0.2, keep=rng.uniform(0.3, 0.6)), *lamps]
    low, high = (0, SLABS_WALK_M + 1.0), (plan.run_m, (pitch - depth) / 2 - 2.0)  # between sidewalks and slabs
    for street_y, side, _ in itertools.product(street_ys.tolist(), (-1, 1), range(round(plan.run_m / 14.0))):
        x, offset = rng.uniform(low, high).tolist()
        spots.append(Spot(_plant(rng, 5.0), x, street_y + side * offset, rng.uniform(0, 2 * np.pi)))
    return Site(plan.line, spots, _street(plan.line, SLABS_WALK_M, rolling(rng)))


def _plant(rng: np.random.Generator, max_crown_m: float) -> ObjectModel:
    """Tree with a crown of 2.5 to `max_crown_m` metres or, with probability 0.3, a bush."""
    return tree(rng, (2.5, max_crown_m)) if rng.random() < 0.7 else bush(rng)


def _slab(length: float, depth: float, height: float) -> ObjectModel:
    """Building along x with windows, and porches and balconies at equal distances."""
    body = block(BUILDING, length, depth, height + 1, bottom=-1.0, roughness=0.05, glass=0.25)
    entrances = np.arange(-length / 2 + 5, length / 2 - 4, 10.0).tolist()
    porches = [block(BUILDING, 3.0, 1.4, 2.8, x, -(depth + 1.4) / 2) for x in entrances]
    balconies = [block(BUILDING, 3.5, 1.2, height - 3.0, x, (depth + 1.2) / 2, bottom=2.5) for x in entrances]
    return body, *porches, *balconies


def campus(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Large separate buildings on lawns, 42 to 52 m apart, with paths between them. Two buildings are equal.

    A closed path leads around one building.
    """
    pitch = rng.uniform(42, 52)
    if closed:
        corners, row_count = pitch * np.array([(0, 0), (1, 0), (1, 1), (0, 1)]), 2
        line = rounded(corners, corner_m=1.5, closed=True)
    else:
        plan = rows(length_m, run_m=2 * pitch, pitch_m=pitch, closed=False, back_m=0.0, corner_m=1.5)
        line, row_count = plan.line, plan.count
    columns, lot_rows = np.arange(-1, 3), np.arange(-2, row_count + 1)
    twin, spots = _building(rng, pitch), []
    for column, row in itertools.product(columns.tolist(), lot_rows.tolist()):
        building = twin if row == 0 and column in (0, 1) else _building(rng, pitch)  # twins at the first path
        x, y = (column + 0.5) * pitch, (row + 0.5) * pitch
        spots.append(Spot(building, x, y))
        for _ in range(int(rng.integers(4, 11))):  # plants between the building and the paths around it
            along_edge = rng.uniform(-0.5, 0.5) * pitch
            across_edge = rng.choice((-1, 1)) * (pitch / 2 - rng.uniform(2.5, LAWN_M))
            dx, dy = ((along_edge, across_edge), (across_edge, along_edge))[rng.integers(2)]
            spots.append(Spot(_plant(rng, 6.0), x + dx, y + dy, rng.uniform(0, 2 * np.pi)))
    spots += along(shifted(line, 2.5), ((post(POLE, 0.15, 4.5),), rng.uniform(18, 26)))
    spots += along(shifted(line, -2.6), ((block(OTHER_OBJECT, 1.8, 0.5, 0.8),), rng.uniform(25, 40)))
    min_x, max_x = (pitch * columns[[0, -1]] + (0, pitch)).tolist()
    min_y, max_y = (pitch * lot_rows[[0, -1]] + (0, pitch)).tolist()
    xs, ys = np.arange(min_x, max_x, STEP_M), np.arange(min_y, max_y, STEP_M)
    path_lines = [np.stack([xs, np.full(len(xs), y)], axis=1) for y in np.arange(min_y, max_y + 1, pitch)]
    path_lines += [np.stack([np.full(len(ys), x), ys], axis=1) for x in np.arange(min_x, max_x + 1, pitch)]
    paths = [PaintedStrip(path_line, -1.8, 1.8, SIDEWALK) for path_line in path_lines]
    return Site(line, spots, painted_ground(TERRAIN, paths, rolling(rng)))


def _building(rng: np.random.Generator, pitch: float) -> ObjectModel:
    """Building around the origin, six of ten with a wing at the back, and a row of bicycles in front of it.

    The building is inside a square of `pitch` - 2 LAWN_M metres.
    """
    lot_m = pitch - 2 * LAWN_M
    fractions = rng.uniform((0.55, 0.3, 7, 0.2), (0.95, 0.55, 18, 0.5))
    width, depth, height, glass = (fractions * (lot_m, lot_m, 1, 1)).tolist()
    front = lot_m * rng.uniform(-0.5, -0.35)
    parts = [part._replace(y=part.y + front) for part in house(rng, House(width, depth, height, glass), porch=True)]
    if rng.random() < 0.6:
        length, thickness = rng.uniform(0.6, 0.95) * (lot_m / 2 - front - depth), rng.uniform(0.2, 0.35) * lot_m
        x, y = rng.choice((-1, 1)) * (width - thickness) / 2, front + depth + length / 2
        parts.append(block(BUILDING, thickness, length, height, float(x), y, roughness=0.06, glass=glass))
    x, count, spacing = rng.uniform(-0.3, 0.3) * width, int(rng.integers(6, 17)), rng.uniform(0.5, 0.8)
    bicycle_xs = (x + spacing * (np.arange(count) - count / 2)).tolist()
    return *parts, *(bicycle(rng)[0]._replace(x=x, y=front - 2.6, yaw=np.pi / 2) for x in bicycle_xs)
