"""Campus: large separate buildings on lawns, with paths, trees and bicycle stands. Two of the buildings are equal."""

import itertools

import numpy as np

from sglpr_jax.sim import plants
from sglpr_jax.sim.buildings import House, house
from sglpr_jax.sim.raw_ids import BUILDING, OTHER_OBJECT, POLE, SIDEWALK, TERRAIN
from sglpr_jax.sim.sceneries.site import Site, Spot, Strip, along, block, post, rolling, striped_ground
from sglpr_jax.sim.sceneries.ways import STEP_M, Line, rounded, rows, shifted
from sglpr_jax.sim.things import Part, Thing
from sglpr_jax.sim.vehicles import bicycle

ROW = 2
"""Number of buildings along a path before it turns."""
MORE = 1
"""Number of buildings beyond the driven paths, on each side."""
TWINS = {(0, 0), (1, 0)}
"""Column and row of the two equal buildings. Both are on the left of the first path."""
LAWN_M = 6.0
"""Minimum distance of a building from the middle of a path, in metres."""


def campus(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Buildings 42 to 52 m apart, with a path between each two. A closed path leads around one building."""
    pitch = rng.uniform(42, 52)
    line, count = _around(pitch) if closed else _along(length_m, pitch)
    columns, lines = np.arange(-MORE, ROW + MORE), np.arange(-MORE - 1, count + MORE)
    twin, spots = _building(rng, pitch), []
    for column, row in itertools.product(columns.tolist(), lines.tolist()):
        building = twin if (column, row) in TWINS else _building(rng, pitch)
        x, y = (column + 0.5) * pitch, (row + 0.5) * pitch
        spots += [Spot(building, x, y), *_trees(rng, x, y, pitch)]
    lamps = along(shifted(line, 2.5), lambda: (post(POLE, 0.15, 4.5),), rng.uniform(18, 26))
    benches = along(shifted(line, -2.6), lambda: (block(OTHER_OBJECT, 1.8, 0.5, 0.8),), rng.uniform(25, 40))
    ends = pitch * np.array([columns[0], columns[-1] + 1, lines[0], lines[-1] + 1])
    ground = striped_ground(TERRAIN, [Strip(each, -1.8, 1.8, SIDEWALK) for each in _paths(pitch, ends)], rolling(rng))
    return Site(line, [*spots, *lamps, *benches], ground)


def _along(length_m: float, pitch: float) -> tuple[Line, int]:
    """Path back and forth between the buildings, and the number of its rows."""
    plan = rows(length_m, run_m=ROW * pitch, pitch_m=pitch, closed=False, back_m=0.0, corner_m=1.5)
    return plan.line, plan.count


def _around(pitch: float) -> tuple[Line, int]:
    """Path around the building of column 0 and row 0, and the number of its rows."""
    corners = pitch * np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    return rounded(corners, corner_m=1.5, closed=True), 2


def _paths(pitch: float, ends: np.ndarray) -> list[Line]:
    """Middles of all paths between the buildings, along x and along y."""
    left, right, low, high = ends.tolist()
    along_x, along_y = np.arange(left, right, STEP_M), np.arange(low, high, STEP_M)
    return [
        *(np.stack([along_x, np.full(len(along_x), y)], axis=1) for y in np.arange(low, high + 1, pitch)),
        *(np.stack([np.full(len(along_y), x), along_y], axis=1) for x in np.arange(left, right + 1, pitch)),
    ]


def _building(rng: np.random.Generator, pitch: float) -> Thing:
    """Building around the origin, six of ten with a wing at the back, and a bicycle stand in front of it."""
    room = pitch - 2 * LAWN_M
    wide, deep, high, glass = (rng.uniform((0.55, 0.3, 7, 0.2), (0.95, 0.55, 18, 0.5)) * (room, room, 1, 1)).tolist()
    front = room * rng.uniform(-0.5, -0.35)
    parts = [part._replace(y=part.y + front) for part in house(rng, House(wide, deep, high, glass), porch=True)]
    if rng.random() < 0.6:
        long, thick = rng.uniform(0.6, 0.95) * (room / 2 - front - deep), rng.uniform(0.2, 0.35) * room
        x, y = rng.choice((-1, 1)) * (wide - thick) / 2, front + deep + long / 2
        parts.append(block(BUILDING, thick, long, high, float(x), y, roughness=0.06, glass=glass))
    return *parts, *_stand(rng, rng.uniform(-0.3, 0.3) * wide, front - 2.6)


def _stand(rng: np.random.Generator, x: float, y: float) -> list[Part]:
    """Row of 6 to 16 bicycles along x."""
    count, every = int(rng.integers(6, 17)), rng.uniform(0.5, 0.8)
    places = x + every * (np.arange(count) - count / 2)
    return [bicycle(rng)[0]._replace(x=float(place), y=y, yaw=np.pi / 2) for place in places]


def _trees(rng: np.random.Generator, x: float, y: float, pitch: float) -> list[Spot]:
    """Four to ten trees and bushes on the lawn around a building."""
    spots = []
    for _ in range(int(rng.integers(4, 11))):
        along_path, away = rng.uniform(-0.5, 0.5) * pitch, rng.choice((-1, 1)) * (pitch / 2 - rng.uniform(2.5, LAWN_M))
        dx, dy = ((along_path, away), (away, along_path))[rng.integers(2)]
        thing = plants.tree(rng, (2.5, 6.0)) if rng.random() < 0.7 else plants.bush(rng)
        spots.append(Spot(thing, x + dx, y + dy, rng.uniform(0, 2 * np.pi)))
    return spots
