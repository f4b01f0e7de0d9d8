"""Walled places of equal size in a row, with a path from one to the next or criss-cross through a single one."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.sim.raw_ids import BUILDING
from sglpr_jax.sim.sceneries.site import block
from sglpr_jax.sim.sceneries.ways import STEP_M, Line, rounded
from sglpr_jax.sim.things import Part, Thing

THICK_M = 0.3
GATE_M = 3.2
"""Width of the gate between two places, in metres."""
MARGIN_M = 2.5
"""Minimum distance of the corners of a path from the walls, in metres."""
BEND = 0.15
"""Maximum distance of gates and bends from the middle of a place, as a fraction of its width."""
CORNER_M = 0.6
STRAIGHT_M = 1.5
"""Length of the straight path on each side of a gate, in metres."""


class Places(NamedTuple):
    """Places along x, each `long_m` long and `wide_m` wide. Place k is around ((k + 0.5) * long_m, 0)."""

    line: Line
    walls: Thing  # of all places, in the frame of the world
    count: int


def places(
    rng: np.random.Generator, length_m: float, closed: bool, *, long_m: float, wide_m: float, height_m: float
) -> Places:
    """Draws a path of about `length_m` metres through one place after another, joined by gates.

    A closed path stays in a single place, and crosses itself.
    """
    if closed:
        line, gates = _criss_cross(rng, length_m, long_m, wide_m), []
    else:
        count = int(np.ceil(length_m / long_m)) + 1
        gates = (wide_m * rng.uniform(-BEND, BEND, count - 1)).tolist()
        line = _onward(rng, gates, long_m, wide_m)[: round(length_m / STEP_M)]
    ends, half = (len(gates) + 1) * long_m, wide_m / 2
    walls = [wall((0.0, side * half), (ends, side * half), height_m) for side in (-1, 1)]
    walls += [wall((x, -half), (x, half), height_m) for x in (0.0, ends)]
    for k, y in enumerate(gates, 1):
        walls.append(wall((k * long_m, -half), (k * long_m, y - GATE_M / 2), height_m))
        walls.append(wall((k * long_m, y + GATE_M / 2), (k * long_m, half), height_m))
    return Places(line, tuple(walls), len(gates) + 1)


def anywhere(
    rng: np.random.Generator, count: int, *, long_m: float, wide_m: float, away_m: float = 1.0
) -> list[tuple[float, float, float]]:
    """Random x, y and heading of `count` things in a place, `away_m` or more from its walls."""
    low, high = np.array((away_m, away_m - wide_m / 2, 0)), np.array((long_m - away_m, wide_m / 2 - away_m, 2 * np.pi))
    return [(x, y, heading) for x, y, heading in rng.uniform(low, high, (count, 3)).tolist()]


def _onward(rng: np.random.Generator, gates: list[float], long_m: float, wide_m: float) -> Line:
    """Path along x through all gates, with a bend in the middle of each place."""
    bends = (wide_m * rng.uniform(-BEND, BEND, len(gates) + 1)).tolist()
    corners = [(MARGIN_M, bends[0])]
    for k, gate in enumerate(gates):
        x = (k + 1) * long_m
        corners += [((k + 0.5) * long_m, bends[k]), (x - STRAIGHT_M, gate), (x + STRAIGHT_M, gate)]
    corners.append(((len(gates) + 1) * long_m - MARGIN_M, bends[-1]))
    return rounded(np.array(corners), corner_m=CORNER_M)


def _criss_cross(rng: np.random.Generator, length_m: float, long_m: float, wide_m: float) -> Line:
    """Closed path between random corners, each at least half the width of the place from the corner before."""
    low, high = np.array((MARGIN_M, MARGIN_M - wide_m / 2)), np.array((long_m - MARGIN_M, wide_m / 2 - MARGIN_M))
    corners = [rng.uniform(low, high)]
    while len(corners) < 3 or _around(np.array(corners)) < length_m:
        corner = rng.uniform(low, high)
        if np.linalg.norm(corner - corners[-1]) > min(long_m, wide_m) / 2:
            corners.append(corner)
    return rounded(np.array(corners), corner_m=CORNER_M, closed=True)


def _around(corners: Float[np.ndarray, "n 2"]) -> float:
    """Length of a closed polygon, in metres."""
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum())


def wall(start: tuple[float, float], stop: tuple[float, float], height_m: float) -> Part:
    """Wall along x or y."""
    long, wide = (abs(b - a) + THICK_M for a, b in zip(start, stop, strict=True))
    return block(BUILDING, long, wide, height_m, (start[0] + stop[0]) / 2, (start[1] + stop[1]) / 2, roughness=0.02)
