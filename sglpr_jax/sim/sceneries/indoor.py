"""Inside of buildings: a corridor with doors, equal rooms along a corridor, and a floor of an office or a hospital."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.sim.labels import BUILDING, OTHER_GROUND, OTHER_OBJECT
from sglpr_jax.sim.objects import ObjectModel, Primitive, block
from sglpr_jax.sim.placement import Spot
from sglpr_jax.sim.routes import Line
from sglpr_jax.sim.sceneries.site import STEP_M, Site, grid, painted_ground, rounded

WALL_M = 0.2  # thickness of the walls between rooms, in metres
ROOMS_HALF_M = 1.0  # half width of the corridor beside equal rooms, in metres; rooms begin WALL_M farther out
ROOMS_DOOR_M, ROOMS_SIDE_M = 1.4, 0.25  # width of a door, and distance of the paths from its middle, in metres
FLOOR_DOOR_M, FLOOR_SIDE_M = 1.6, 0.15  # the same for the rooms of a floor with wings
ALIKE = 0.6  # probability that a wing has the rooms of the first wing, and that such a room has the same furniture
FRONTS = {"closed": 0.4, "open": 0.25, "glass": 0.2, "hall": 0.15}
"""Probability of each front of a room: a door, an open door, glass with an open door, or only two pillars."""

Point = Float[np.ndarray, "2"]


def corridor(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """One straight corridor, or four corridors at right angles around a core, with a door every 5 to 7 m."""
    half, height, pitch, recess = rng.uniform(1.0, 1.4), rng.uniform(2.4, 3.0), rng.uniform(5, 7), rng.uniform(0.1, 0.3)
    if closed:
        length = (0.5 + rng.uniform(0, 0.15)) * length_m / 2
        width = length_m / 2 - length
        corners = np.array([(0.0, 0.0), (length, 0.0), (length, width), (0.0, width)])
        line = rounded(corners, corner_m=0.5, closed=True)
    else:
        corners = np.array([(-40.0, 0.0), (length_m + 40.0, 0.0)])
        x = np.arange(0, length_m, STEP_M)
        line = np.stack([x, np.zeros(len(x))], axis=1)
    starts = corners if closed else corners[:1]
    spots = []
    for start, stop in zip(starts, np.roll(corners, -1, axis=0), strict=False):
        spots += _corridor_walls(start, stop, half, height, pitch, recess, closed)
    low, high = corners.min(axis=0), corners.max(axis=0)
    (length, width), (x, y) = (high - low + 4).tolist(), ((low + high) / 2).tolist()
    ceiling = Spot((block(BUILDING, length, width, 0.3, bottom=height),), x, y)
    return Site(line, [*spots, ceiling], painted_ground(OTHER_GROUND))


def _corridor_walls(
    start: Point, stop: Point, half: float, height: float, pitch: float, recess: float, closed: bool
) -> list[Spot]:
    """Walls along one straight corridor of half width `half`, with a door about every `pitch` metres.

    Doors are `recess` metres behind the walls. If `closed`, the left wall belongs to the core and is shorter.
    """
    length, direction = float(np.linalg.norm(stop - start)), (stop - start) / np.linalg.norm(stop - start)
    heading = float(np.arctan2(direction[1], direction[0]))
    spots, thickness, door = [], 0.6, 1.0
    for side in (1, -1):
        first_m = side * half if closed else 0.0  # start of the wall, in metres after `start`
        pieces = max(1, round((length - 2 * first_m) / pitch))
        piece_length = (length - 2 * first_m) / pieces
        offset, jamb = half + thickness / 2, (piece_length - door) / 2
        piece = (
            block(BUILDING, jamb, thickness, height, jamb / 2, side * offset),
            block(BUILDING, door, thickness, height, piece_length / 2, side * (offset + recess)),  # door in the middle
            block(BUILDING, jamb, thickness, height, piece_length - jamb / 2, side * offset),
        )
        for k in range(pieces):
            x, y = (start + (first_m + k * piece_length) * direction).tolist()
            spots.append(Spot(piece, x, y, heading))
    return spots


def _visit(door_x: float, side_m: float, deep_m: float, direction: int = 1) -> list[tuple[float, float]]:
    """Corners of a path along x that turns into a room at y > 0 and back, `side_m` beside the door's middle.

    The path goes `deep_m` metres deep. `direction` is 1 or -1: the direction of the path along x.
    """
    near_x, far_x = door_x - direction * side_m, door_x + direction * side_m
    return [(near_x, 0.0), (near_x, deep_m), (far_x, deep_m), (far_x, 0.0)]


def rooms(rng: np.random.Generator, length_m: float, closed: bool, *, equal: bool) -> Site:
    """Rooms of one size along a corridor, with `equal` or with different furniture. The path visits all rooms."""
    pitch, width, depth, height = rng.uniform(7.5, 8.5), *rng.uniform(4.7, 5.3, 2), rng.uniform(2.4, 3.0)
    visit_y = ROOMS_HALF_M + 0.6 * depth
    visit_length = pitch + 2 * visit_y + (pitch if closed else 0.0)  # a closed path returns through the corridor
    count = max(2, round(length_m / visit_length) if closed else int(np.ceil(length_m / visit_length)))
    corners = [(-pitch / 2, 0.0)]
    for k in range(count):
        corners += _visit(k * pitch, ROOMS_SIDE_M, visit_y)
    if closed:  # back on the other side of the corridor
        corners += [(corners[-1][0] + 1.0, 0.0), (corners[-1][0] + 1.0, -0.4), (-pitch / 2, -0.4)]
    line = rounded(corners, corner_m=0.15, closed=closed, length_m=length_m)
    door_xs = pitch * np.arange(-2, count + 2)
    shared_furniture = _room_furniture(rng, width, depth)

    def furniture() -> ObjectModel:
        return shared_furniture if equal else _room_furniture(rng, width, depth)

    furnishings = grid(door_xs, (ROOMS_HALF_M + WALL_M,), furniture)
    room_walls = grid(door_xs, (0.0,), lambda: _room_walls(pitch, width, depth, height))
    middle_x, length = float(door_xs.mean()), pitch * len(door_xs)
    ends = tuple(block(BUILDING, 0.3, 2 * ROOMS_HALF_M, height, x) for x in (-length / 2, length / 2))
    wall = block(BUILDING, length, 0.3, height, y=-ROOMS_HALF_M - 0.15)
    ceiling = block(BUILDING, length, 2 * ROOMS_HALF_M + 2 * depth + 2, 0.3, bottom=height)
    spots = [*furnishings, *room_walls, Spot((*ends, wall, ceiling), middle_x, 0.0)]
    return Site(line, spots, painted_ground(OTHER_GROUND))


def _room_walls(pitch: float, width: float, depth: float, height: float) -> ObjectModel:
    """Walls of a room with its door at x = 0, and the block between it and the next room."""
    front, jamb = ROOMS_HALF_M + WALL_M / 2, (width - ROOMS_DOOR_M) / 2
    jamb_x = (ROOMS_DOOR_M + jamb) / 2
    return (
        *(block(BUILDING, jamb, WALL_M, height, x, front) for x in (-jamb_x, jamb_x)),
        block(BUILDING, pitch - width, depth + WALL_M, height, pitch / 2, ROOMS_HALF_M + (depth + WALL_M) / 2),
        block(BUILDING, pitch, 0.3, height, y=ROOMS_HALF_M + WALL_M + depth + 0.15),
    )


def _room_furniture(rng: np.random.Generator, room_width: float, room_depth: float) -> ObjectModel:
    """Cupboards, desks and shelves along the walls of a room: two on each side and two at the back."""
    parts = []
    for fraction in (0.1, 0.5):  # of the depth where furniture at the sides begins; 0.1 is left at the back, 0.5 right
        for side in (-1, 1):
            length, thickness, height = rng.uniform((0.5, 0.35, 0.6), (1.8, 0.8, 2.1)).tolist()
            y = fraction * room_depth + length / 2 + rng.uniform(0, 0.1) * room_depth
            parts.append(block(OTHER_OBJECT, thickness, length, height, side * (room_width - thickness) / 2, y))
        length, thickness, height = rng.uniform((0.5, 0.35, 0.6), (1.6, 0.7, 2.1)).tolist()
        x = (fraction - 0.3) * 2 * (room_width / 2 - 0.9) + rng.uniform(-0.4, 0.4)
        parts.append(block(OTHER_OBJECT, length, thickness, height, x, room_depth - thickness / 2))
    return tuple(parts)


class Floor(NamedTuple):
    """Sizes of a floor, in metres. Wings run along x, from a cross corridor at x = 0 to one at x = `run_m`."""

    run_m: float
    half_m: float  # half width of all corridors
    deep_m: float  # depth of the rooms
    height_m: float

    @property
    def pitch_m(self) -> float:
        """Distance between two wings."""
        return 2 * (self.half_m + WALL_M + self.deep_m + WALL_M)


class Room(NamedTuple):
    """Room on the left side of a wing, or on its right side (`side` -1). Positions are in the frame of the wing."""

    x_m: float
    wide_m: float
    side: int
    front: str  # of `FRONTS`
    furniture: list[Primitive]


def indoor(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Wings of 22 to 30 m with rooms of 3 to 8 m, halls, glass fronts, and a branch in the middle of each wing.

    Six of ten wings look like the first one. The path visits a room in each wing, and two wings if it is closed.
    """
    floor = Floor(*rng.uniform((22, 1.0, 4.2, 2.5), (30, 1.4, 6.0, 3.2)).tolist())
    count = 2 if closed else int(np.ceil(length_m / (floor.run_m + floor.pitch_m))) + 1
    first_wing = _wing(rng, floor)

    def similar_room(room: Room) -> Room:
        return room if rng.random() < ALIKE else room._replace(furniture=_furniture(rng, room.wide_m, floor.deep_m))

    def similar_wing() -> list[Room]:
        return [similar_room(room) for room in first_wing] if rng.random() < ALIKE else _wing(rng, floor)

    wings = [similar_wing() for _ in range(count + 2)]  # with one beyond each end of the path
    line = _tour(floor, [wing[0] for wing in wings[1:-1]], length_m, closed)
    spots = []
    for k, wing in enumerate(wings, -1):
        for room in wing:
            furniture = [(part._replace(y=part.y + (floor.half_m + WALL_M)),) for part in room.furniture]
            for thing in (_walls(floor, room), *furniture):
                spots.append(Spot(thing, room.x_m, k * floor.pitch_m, side=room.side))
    return Site(line, [*spots, *_shell(floor, count)], painted_ground(OTHER_GROUND))


def _wing(rng: np.random.Generator, floor: Floor) -> list[Room]:
    """Draws the rooms of one wing, on both sides of the branch in its middle. The first, visited one is open."""
    wing = []
    for side in (1, -1):
        for start in (floor.half_m, floor.run_m / 2 + floor.half_m):
            length = floor.run_m / 2 - 2 * floor.half_m
            widths = rng.uniform(1, 2.2, int(rng.integers(2, 1 + max(2, round(length / 4)))))
            widths *= length / widths.sum()
            for x, width in zip(start + np.cumsum(widths) - widths / 2, widths.tolist(), strict=True):
                front = list(FRONTS)[rng.choice(len(FRONTS), p=list(FRONTS.values()))]
                wing.append(Room(float(x), width, side, front, _furniture(rng, width, floor.deep_m)))
    wing[0] = wing[0]._replace(front="open")
    return wing


def _furniture(rng: np.random.Generator, width: float, depth: float) -> list[Primitive]:
    """Furniture along the walls, and a desk, in a room that begins at y = 0 with its door at x = 0."""
    parts = []
    for side in (-1, 1):
        for start_y in np.arange(0.2, depth - 1.8, rng.uniform(1.6, 2.4)):
            length, thickness, height = rng.uniform((0.6, 0.35, 0.7), (1.5, 0.7, 2.1)).tolist()
            if rng.random() < 0.8:
                y = float(start_y) + length / 2
                parts.append(block(OTHER_OBJECT, thickness, length, height, side * (width - thickness - 0.2) / 2, y))
    length, thickness, height = rng.uniform((0.8, 0.35, 0.7), (2.0, 0.7, 2.1)).tolist()
    x = rng.uniform(-0.3, 0.3) * (width - length)
    parts.append(block(OTHER_OBJECT, length, thickness, height, x, depth - thickness / 2))
    if width > 4.5:
        x = float(rng.choice((-1, 1))) * width / 4
        parts.append(block(OTHER_OBJECT, 0.8, 1.6, 0.75, x, rng.uniform(0.4, 0.6) * depth))
    return parts


def _tour(floor: Floor, visited: list[Room], length_m: float, closed: bool) -> Line:
    """Path back and forth through the wings, into one room of each, and back along the cross corridor if closed."""
    corners = []
    for k, room in enumerate(visited):
        direction, start_x, end_x = (1, 0.0, floor.run_m) if k % 2 == 0 else (-1, floor.run_m, 0.0)
        visit = _visit(room.x_m, FLOOR_SIDE_M, floor.half_m + 2.5, direction)
        corners += [(x, y + k * floor.pitch_m) for x, y in ((start_x, 0.0), *visit, (end_x, 0.0))]
    return rounded(corners, corner_m=0.15, closed=closed, length_m=length_m)


def _walls(floor: Floor, room: Room) -> ObjectModel:
    """Front, back and side walls of a room."""
    width, height = room.wide_m, floor.height_m
    front_y, room_y = floor.half_m + WALL_M / 2, floor.half_m + WALL_M  # middle of the front wall, start of the room
    middle_y, wall_x = room_y + floor.deep_m / 2, width / 2 - WALL_M / 4
    walls = [block(BUILDING, WALL_M / 2, floor.deep_m, height, x, middle_y) for x in (-wall_x, wall_x)]
    walls.append(block(BUILDING, width, WALL_M, height, y=room_y + floor.deep_m + WALL_M / 2))
    if room.front == "hall":
        return *walls, *(block(BUILDING, 0.4, 0.4, height, side * width / 3, front_y + 0.2) for side in (-1, 1))
    jamb, glass = (width - FLOOR_DOOR_M) / 2, 0.7 if room.front == "glass" else 0.0
    jamb_x = (width - jamb) / 2
    walls += [block(BUILDING, jamb, WALL_M, height, x, front_y, glass=glass) for x in (-jamb_x, jamb_x)]
    if room.front == "closed":
        walls.append(block(BUILDING, FLOOR_DOOR_M, 0.05, height, y=front_y + 0.08))
    return tuple(walls)


def _shell(floor: Floor, count: int) -> list[Spot]:
    """Outer walls and ceiling of the floor. The wall at x = 0 is partly glass."""
    min_y, max_y = -1.5 * floor.pitch_m, (count + 0.5) * floor.pitch_m
    x, y, width = floor.run_m / 2, (min_y + max_y) / 2, max_y - min_y
    length, wall_x = floor.run_m + 2 * floor.half_m, floor.run_m / 2 + floor.half_m + WALL_M / 2
    walls = [
        block(BUILDING, WALL_M, width, floor.height_m, -wall_x, glass=0.6),
        block(BUILDING, WALL_M, width, floor.height_m, wall_x),
        *(block(BUILDING, length, WALL_M, floor.height_m, y=side * width / 2) for side in (-1, 1)),
    ]
    ceiling = block(BUILDING, length, width, 0.3, bottom=floor.height_m)
    return [Spot((part,), x, y) for part in (*walls, ceiling)]
