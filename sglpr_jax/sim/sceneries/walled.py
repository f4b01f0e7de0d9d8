"""Walled yards and halls of equal size in a row, crossed one after another, or a single one criss-cross."""

import numpy as np

from sglpr_jax.sim.labels import BUILDING, OTHER_GROUND, OTHER_OBJECT, PARKING, POLE
from sglpr_jax.sim.objects import ObjectModel, bicycle, block, bush, car, post, tree
from sglpr_jax.sim.placement import Spot
from sglpr_jax.sim.routes import Line
from sglpr_jax.sim.sceneries.site import Site, grid, painted_ground, rounded, wall

GATE_M = 3.2  # width of the gate between two places, in metres
MARGIN_M = 2.5  # minimum distance of the corners of a path from the walls, in metres
BEND = 0.15  # maximum distance of gates and bends from the middle of a place, as a fraction of its width


def _places(
    rng: np.random.Generator, length_m: float, closed: bool, *, long_m: float, wide_m: float, height_m: float
) -> tuple[Line, ObjectModel, int]:
    """Path, walls and number of places along x that are joined by gates. A closed path stays in a single one."""
    if closed:
        line, gates = _criss_cross(rng, length_m, long_m, wide_m), []
    else:
        count = int(np.ceil(length_m / long_m)) + 1
        gates = (wide_m * rng.uniform(-BEND, BEND, count - 1)).tolist()
        bends = (wide_m * rng.uniform(-BEND, BEND, count)).tolist()
        corners = [(MARGIN_M, bends[0])]
        for k, (gate, bend) in enumerate(zip(gates, bends, strict=False)):
            x = (k + 1) * long_m
            corners += [((k + 0.5) * long_m, bend), (x - 1.5, gate), (x + 1.5, gate)]  # straight through the gate
        line = rounded([*corners, (count * long_m - MARGIN_M, bends[-1])], corner_m=0.6, length_m=length_m)
    ends, half = (len(gates) + 1) * long_m, wide_m / 2
    walls = [wall((0.0, side * half), (ends, side * half), height_m) for side in (-1, 1)]
    walls += [wall((x, -half), (x, half), height_m) for x in (0.0, ends)]
    for k, y in enumerate(gates, 1):
        wall_parts = (-half, y - GATE_M / 2), (y + GATE_M / 2, half)
        walls += [wall((k * long_m, low), (k * long_m, high), height_m) for low, high in wall_parts]
    return line, tuple(walls), len(gates) + 1


def _anywhere(
    rng: np.random.Generator, long_m: float, wide_m: float, area_m2: float, away_m: float
) -> list[tuple[float, float, float]]:
    """Random x, y and heading of things in a place, about one for `area_m2`, `away_m` or more from its walls."""
    count, half = round(long_m * wide_m / area_m2 * rng.uniform(0.7, 1.3)), wide_m / 2
    low, high = (away_m, away_m - half, 0), (long_m - away_m, half - away_m, 2 * np.pi)
    return [(x, y, heading) for x, y, heading in rng.uniform(low, high, (count, 3)).tolist()]


def _criss_cross(rng: np.random.Generator, length_m: float, long_m: float, wide_m: float) -> Line:
    """Closed path between random corners, each at least half the width of the place from the corner before."""
    low, high = np.array((MARGIN_M, MARGIN_M - wide_m / 2)), np.array((long_m - MARGIN_M, wide_m / 2 - MARGIN_M))
    corners = [rng.uniform(low, high)]
    while len(corners) < 3 or np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum() < length_m:
        corner = rng.uniform(low, high)
        if np.linalg.norm(corner - corners[-1]) > min(long_m, wide_m) / 2:
            corners.append(corner)
    return rounded(corners, corner_m=0.6, closed=True)


def yard(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Yards of 15 to 24 m with equal walls and different things, joined by gates. A closed path stays in one yard."""
    long, width, height = rng.uniform((15, 15, 3), (24, 24, 8)).tolist()
    line, walls, count = _places(rng, length_m, closed, long_m=long, wide_m=width, height_m=height)
    spots = [Spot(walls, 0.0, 0.0)]
    for k in range(count):
        spots += [
            Spot(_lumber(rng), x + k * long, y, heading) for x, y, heading in _anywhere(rng, long, width, 22.0, 1.0)
        ]
        for side in (-1, 1):  # sheds, stairs and ducts at the two walls along x
            for place in rng.uniform(2.0, long - 2.0, int(rng.integers(1, 4))).tolist():
                length, depth, high = rng.uniform((0.5, 0.4, 1.0), (3.0, 1.6, 3.0)).tolist()
                annex = (block(OTHER_OBJECT, length, depth, high),)
                spots.append(Spot(annex, k * long + place, side * (width - depth - 0.3) / 2))
    return Site(line, spots, painted_ground(PARKING))


def _lumber(rng: np.random.Generator) -> ObjectModel:
    """Crate, bin, barrel, pole, plant or vehicle."""
    length, width, height = rng.uniform((0.4, 0.4, 0.6), (1.8, 1.4, 2.6)).tolist()
    kinds = (
        lambda: (block(OTHER_OBJECT, length, width, height),),
        lambda: (post(OTHER_OBJECT, width, 0.6 * height),),
        lambda: (post(POLE, 0.12, 2 * height),),
        lambda: tree(rng, (1.5, 3.5)) if rng.random() < 0.4 else bush(rng, 0.7),
        lambda: car(rng),
        lambda: bicycle(rng),
    )
    return kinds[rng.choice(6, p=[0.45, 0.15, 0.1, 0.2, 0.05, 0.05])]()


def hall(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Halls of 30 to 60 m with equal walls and columns and different things. A closed path stays in one."""
    length, width, height, span = rng.uniform((30, 30, 5, 6), (60, 45, 9, 10)).tolist()
    line, walls, count = _places(rng, length_m, closed, long_m=length, wide_m=width, height_m=height)
    column, along = (block(POLE, 0.4, 0.4, height),), count * length
    columns = grid(np.arange(span / 2, along, span), np.arange((span - width) / 2, width / 2, span), lambda: column)
    ceiling = block(BUILDING, along, width, 0.3, along / 2, bottom=height, roughness=0.02)
    spots = [Spot((*walls, ceiling), 0.0, 0.0), *columns]
    for k in range(count):
        for x, y, heading in _anywhere(rng, length, width, 40.0, 2.5):
            turned = heading if rng.random() < 0.3 else round(2 * heading / np.pi) * np.pi / 2
            spots.append(Spot(_machine(rng), x + k * length, y, turned))
    return Site(line, spots, painted_ground(OTHER_GROUND))


def _machine(rng: np.random.Generator) -> ObjectModel:
    """Machine, shelf or stack of crates."""
    match rng.integers(3):
        case 0:
            length, width, height = rng.uniform((1.5, 1.0, 1.0), (5.0, 2.5, 2.2)).tolist()
            x, tower = rng.uniform(-0.3, 0.3) * length, rng.uniform(0.3, 1.5)
            body = block(OTHER_OBJECT, length, width, height)
            return body, block(OTHER_OBJECT, 0.35 * length, 0.7 * width, tower, x, bottom=height)
        case 1:
            length, width, height = rng.uniform((2.0, 0.5, 1.8), (6.0, 1.1, 4.0)).tolist()
            return (block(OTHER_OBJECT, length, width, height, roughness=0.15, porosity=0.25),)
        case _:
            size = rng.uniform(0.6, 1.3, 3)
            return tuple(
                block(OTHER_OBJECT, *(size * rng.uniform(0.8, 1.1, 3)).tolist(), x=1.4 * k)
                for k in range(int(rng.integers(1, 4)))
            )
