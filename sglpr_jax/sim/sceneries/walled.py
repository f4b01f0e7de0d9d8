"""Walled yards and halls. An open path crosses a row of places of equal size, a closed path one place repeatedly."""

import numpy as np

from sglpr_jax.sim.labels import BUILDING, OTHER_GROUND, OTHER_OBJECT, PARKING, POLE
from sglpr_jax.sim.objects import ObjectModel, bicycle, block, bush, car, post, tree
from sglpr_jax.sim.placement import Spot
from sglpr_jax.sim.routes import Line
from sglpr_jax.sim.sceneries.site import Site, grid, painted_ground, rounded, wall

GATE_M = 3.2  # width of the gate between two yards or halls, in metres
MARGIN_M = 2.5  # minimum distance of the corners of a path from the walls, in metres
BEND = 0.15  # maximum distance of gates and bends from the middle of a yard or hall, as a fraction of its width


def _path_and_walls(
    rng: np.random.Generator, length_m: float, closed: bool, *, place_length: float, width: float, height: float
) -> tuple[Line, ObjectModel, int]:
    """Path, walls and number of equal walled places in a row along x, joined by gates. All sizes are in metres.

    A closed path stays in a single place.
    """
    half = width / 2
    if closed:
        line, gate_ys = _criss_cross(rng, length_m, place_length, width), []
    else:
        count = int(np.ceil(length_m / place_length)) + 1
        gate_ys = (width * rng.uniform(-BEND, BEND, count - 1)).tolist()
        bend_ys = (width * rng.uniform(-BEND, BEND, count)).tolist()
        corners = [(MARGIN_M, bend_ys[0])]
        for k, (gate_y, bend_y) in enumerate(zip(gate_ys, bend_ys[:-1], strict=True)):
            gate_x = (k + 1) * place_length
            corners.append(((k + 0.5) * place_length, bend_y))
            corners += [(gate_x - 1.5, gate_y), (gate_x + 1.5, gate_y)]  # straight through the gate
        corners.append((count * place_length - MARGIN_M, bend_ys[-1]))
        line = rounded(corners, corner_m=0.6, length_m=length_m)
    max_x = (len(gate_ys) + 1) * place_length
    walls = [wall((0.0, y), (max_x, y), height) for y in (-half, half)]
    walls += [wall((x, -half), (x, half), height) for x in (0.0, max_x)]
    for k, gate_y in enumerate(gate_ys, 1):
        gate_x = k * place_length
        walls.append(wall((gate_x, -half), (gate_x, gate_y - GATE_M / 2), height))
        walls.append(wall((gate_x, gate_y + GATE_M / 2), (gate_x, half), height))
    return line, tuple(walls), len(gate_ys) + 1


def _random_poses(
    rng: np.random.Generator, place_length: float, width: float, area_m2: float, margin_m: float
) -> list[tuple[float, float, float]]:
    """Random x, y and heading in a yard or hall, about one for `area_m2`, `margin_m` or more from the walls."""
    count, half = round(place_length * width / area_m2 * rng.uniform(0.7, 1.3)), width / 2
    low, high = (margin_m, margin_m - half, 0), (place_length - margin_m, half - margin_m, 2 * np.pi)
    return [(x, y, heading) for x, y, heading in rng.uniform(low, high, (count, 3)).tolist()]


def _criss_cross(rng: np.random.Generator, length_m: float, place_length: float, width: float) -> Line:
    """Closed path of at least `length_m` between random corners in a yard or hall of this length and width.

    The distance of successive corners is at least half the length or width.
    """
    low = np.array((MARGIN_M, MARGIN_M - width / 2))
    high = np.array((place_length - MARGIN_M, width / 2 - MARGIN_M))
    corners = [rng.uniform(low, high)]
    while len(corners) < 3 or np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum() < length_m:
        corner = rng.uniform(low, high)
        if np.linalg.norm(corner - corners[-1]) > min(place_length, width) / 2:
            corners.append(corner)
    return rounded(corners, corner_m=0.6, closed=True)


def yard(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Yards of 15 to 24 m with equal walls and different objects, joined by gates. A closed path stays in one yard."""
    length, width, height = rng.uniform((15, 15, 3), (24, 24, 8)).tolist()
    line, walls, count = _path_and_walls(rng, length_m, closed, place_length=length, width=width, height=height)
    spots = [Spot(walls, 0.0, 0.0)]
    for k in range(count):
        for x, y, heading in _random_poses(rng, length, width, 22.0, 1.0):
            spots.append(Spot(_yard_object(rng), x + k * length, y, heading))
        for side in (-1, 1):  # sheds, stairs and ducts at the two walls along x
            for x in rng.uniform(2.0, length - 2.0, int(rng.integers(1, 4))).tolist():
                size = rng.uniform((0.5, 0.4, 1.0), (3.0, 1.6, 3.0)).tolist()
                annex = (block(OTHER_OBJECT, *size),)
                spots.append(Spot(annex, k * length + x, side * (width - size[1] - 0.3) / 2))
    return Site(line, spots, painted_ground(PARKING))


def _yard_object(rng: np.random.Generator) -> ObjectModel:
    """Crate, barrel, pole, plant, car or bicycle."""
    length, width, height = rng.uniform((0.4, 0.4, 0.6), (1.8, 1.4, 2.6)).tolist()
    makers = (
        lambda: (block(OTHER_OBJECT, length, width, height),),
        lambda: (post(OTHER_OBJECT, width, 0.6 * height),),
        lambda: (post(POLE, 0.12, 2 * height),),
        lambda: tree(rng, (1.5, 3.5)) if rng.random() < 0.4 else bush(rng, 0.7),
        lambda: car(rng),
        lambda: bicycle(rng),
    )
    return makers[rng.choice(6, p=[0.45, 0.15, 0.1, 0.2, 0.05, 0.05])]()


def hall(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Halls of 30 to 60 m with equal walls and columns and different machines. A closed path stays in one hall."""
    length, width, height, spacing = rng.uniform((30, 30, 5, 6), (60, 45, 9, 10)).tolist()
    line, walls, count = _path_and_walls(rng, length_m, closed, place_length=length, width=width, height=height)
    column, max_x = (block(POLE, 0.4, 0.4, height),), count * length
    column_ys = np.arange((spacing - width) / 2, width / 2, spacing)
    columns = grid(np.arange(spacing / 2, max_x, spacing), column_ys, lambda: column)
    ceiling = block(BUILDING, max_x, width, 0.3, max_x / 2, bottom=height, roughness=0.02)
    spots = [Spot((*walls, ceiling), 0.0, 0.0), *columns]
    for k in range(count):
        for x, y, heading in _random_poses(rng, length, width, 40.0, 2.5):
            if rng.random() >= 0.3:  # seven of ten are parallel to a wall
                heading = round(2 * heading / np.pi) * np.pi / 2
            spots.append(Spot(_machine(rng), x + k * length, y, heading))
    return Site(line, spots, painted_ground(OTHER_GROUND))


def _machine(rng: np.random.Generator) -> ObjectModel:
    """Machine, shelf or stack of crates."""
    match rng.integers(3):
        case 0:
            length, width, height = rng.uniform((1.5, 1.0, 1.0), (5.0, 2.5, 2.2)).tolist()
            x, top_height = rng.uniform(-0.3, 0.3) * length, rng.uniform(0.3, 1.5)
            body = block(OTHER_OBJECT, length, width, height)
            return body, block(OTHER_OBJECT, 0.35 * length, 0.7 * width, top_height, x, bottom=height)
        case 1:
            length, width, height = rng.uniform((2.0, 0.5, 1.8), (6.0, 1.1, 4.0)).tolist()
            return (block(OTHER_OBJECT, length, width, height, roughness=0.15, porosity=0.25),)
        case _:
            size = rng.uniform(0.6, 1.3, 3)
            return tuple(
                block(OTHER_OBJECT, *(size * rng.uniform(0.8, 1.1, 3)).tolist(), x=1.4 * k)
                for k in range(int(rng.integers(1, 4)))
            )
