"""Floor of an office or a hospital: parallel wings with rooms on both sides, joined by cross corridors."""

import dataclasses
from typing import Literal

import numpy as np

from sglpr_jax.sim.raw_ids import BUILDING, OTHER_GROUND, OTHER_OBJECT
from sglpr_jax.sim.sceneries.site import Site, Spot, block, even_ground
from sglpr_jax.sim.sceneries.ways import STEP_M, Line, rounded
from sglpr_jax.sim.things import Part, Thing

THICK_M = 0.2
DOOR_M = 1.6
SIDE_M = 0.15
"""Distance from the middle of a door to the paths into the room and out of it, in metres."""
INSIDE_M = 2.5
"""Distance that the path goes into a room, in metres."""
VISITED = 0
"""Number of the room of each wing that the path visits. It is on the left."""
MORE = 1
"""Number of wings before the first and after the last driven wing."""
ALIKE = 0.6
"""Probability that a wing has the rooms of the first wing, and that such a room has the same furniture."""
Front = Literal["closed", "open", "glass", "hall"]
"""Front of a room: a closed door, an open door, glass with an open door, or only two pillars."""
FRONTS: dict[Front, float] = {"closed": 0.4, "open": 0.25, "glass": 0.2, "hall": 0.15}
"""Probability of each front."""


@dataclasses.dataclass(frozen=True)
class Floor:
    """Sizes of a floor, in metres. Wings run along x, from a cross corridor at x = 0 to one at x = `run_m`."""

    run_m: float
    half_m: float
    """Half width of all corridors."""
    deep_m: float
    """Depth of the rooms."""
    height_m: float

    @property
    def pitch_m(self) -> float:
        """Distance between two wings."""
        return 2 * (self.half_m + THICK_M + self.deep_m + THICK_M)


@dataclasses.dataclass(frozen=True)
class Room:
    """Room on the left side of a wing, or on its right side (`side` -1). Positions are in the frame of the wing."""

    x_m: float
    wide_m: float
    side: int
    front: Front
    furniture: list[Part]


def indoor(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Wings of 22 to 30 m with rooms of 3 to 8 m, halls, glass fronts, and a branch in the middle of each wing.

    Six of ten wings have the rooms of the first wing, partly with the same furniture. The path visits one room in each
    wing. A closed path leads through two wings.
    """
    floor = Floor(*rng.uniform((22, 1.0, 4.2, 2.5), (30, 1.4, 6.0, 3.2)).tolist())
    count = 2 if closed else int(np.ceil(length_m / (floor.run_m + floor.pitch_m))) + 1
    first = _rooms(rng, floor)
    wings = [_like(rng, first, floor) if rng.random() < ALIKE else _rooms(rng, floor) for _ in range(count + 2 * MORE)]
    line = _tour(floor, [rooms[VISITED] for rooms in wings[MORE : MORE + count]], closed)
    spots = [spot for k, rooms in enumerate(wings, -MORE) for room in rooms for spot in _spots(floor, room, k)]
    return Site(
        line if closed else line[: round(length_m / STEP_M)], [*spots, *_shell(floor, count)], even_ground(OTHER_GROUND)
    )


def _rooms(rng: np.random.Generator, floor: Floor) -> list[Room]:
    """Rooms of one wing, on both sides of the branch in its middle. The visited room has an open door."""
    rooms = []
    for side in (1, -1):
        for start in (floor.half_m, floor.run_m / 2 + floor.half_m):
            length = floor.run_m / 2 - 2 * floor.half_m
            widths = rng.uniform(1, 2.2, int(rng.integers(2, 1 + max(2, round(length / 4)))))
            widths *= length / widths.sum()
            for x, wide in zip(start + np.cumsum(widths) - widths / 2, widths.tolist(), strict=True):
                front = list(FRONTS)[rng.choice(len(FRONTS), p=list(FRONTS.values()))]
                rooms.append(Room(float(x), wide, side, front, _furniture(rng, wide, floor.deep_m)))
    rooms[VISITED] = dataclasses.replace(rooms[VISITED], front="open")
    return rooms


def _like(rng: np.random.Generator, rooms: list[Room], floor: Floor) -> list[Room]:
    """The same rooms, partly with other furniture."""
    return [
        room
        if rng.random() < ALIKE
        else dataclasses.replace(room, furniture=_furniture(rng, room.wide_m, floor.deep_m))
        for room in rooms
    ]


def _furniture(rng: np.random.Generator, wide: float, deep: float) -> list[Part]:
    """Cupboards, shelves or beds along the side walls and at the back, and a desk, in the frame of a room.

    The room begins at y = 0, and its door is at x = 0.
    """
    parts = []
    for side in (-1, 1):
        for low in np.arange(0.2, deep - 1.8, rng.uniform(1.6, 2.4)):
            long, thick, high = rng.uniform((0.6, 0.35, 0.7), (1.5, 0.7, 2.1)).tolist()
            if rng.random() < 0.8:
                y = float(low) + long / 2
                parts.append(block(OTHER_OBJECT, thick, long, high, side * (wide - thick - 0.2) / 2, y))
    long, thick, high = rng.uniform((0.8, 0.35, 0.7), (2.0, 0.7, 2.1)).tolist()
    parts.append(block(OTHER_OBJECT, long, thick, high, rng.uniform(-0.3, 0.3) * (wide - long), deep - thick / 2))
    if wide > 4.5:
        x = float(rng.choice((-1, 1))) * wide / 4
        parts.append(block(OTHER_OBJECT, 0.8, 1.6, 0.75, x, rng.uniform(0.4, 0.6) * deep))
    return parts


def _tour(floor: Floor, visited: list[Room], closed: bool) -> Line:
    """Path back and forth through the wings, into one room of each, and back along the cross corridor if closed."""
    corners = []
    for k, room in enumerate(visited):
        ahead, deep = (1, -1)[k % 2], floor.half_m + INSIDE_M
        visit = [(-SIDE_M, 0.0), (-SIDE_M, deep), (SIDE_M, deep), (SIDE_M, 0.0)]
        way = [(room.x_m + ahead * x, y) for x, y in visit]
        ends = [(0.0, 0.0), (floor.run_m, 0.0)][::ahead]
        corners += [(x, y + k * floor.pitch_m) for x, y in (ends[0], *way, ends[1])]
    return rounded(np.array(corners), corner_m=0.15, closed=closed)


def _spots(floor: Floor, room: Room, wing: int) -> list[Spot]:
    """Walls and furniture of a room. Each piece of furniture is left out by itself if the path passes there."""
    x, y, begin = room.x_m, wing * floor.pitch_m, floor.half_m + THICK_M
    inside = [(part._replace(y=part.y + begin),) for part in room.furniture]
    return [Spot(thing, x, y, side=room.side) for thing in (_walls(floor, room), *inside)]


def _walls(floor: Floor, room: Room) -> Thing:
    """Front, back and side walls of a room."""
    wide, high, front, begin = room.wide_m, floor.height_m, floor.half_m + THICK_M / 2, floor.half_m + THICK_M
    middle, aside = begin + floor.deep_m / 2, wide / 2 - THICK_M / 4
    walls = [block(BUILDING, THICK_M / 2, floor.deep_m, high, side * aside, middle) for side in (-1, 1)]
    walls.append(block(BUILDING, wide, THICK_M, high, y=begin + floor.deep_m + THICK_M / 2))
    if room.front == "hall":
        return *walls, *(block(BUILDING, 0.4, 0.4, high, side * wide / 3, front + 0.2) for side in (-1, 1))
    jamb, glass = (wide - DOOR_M) / 2, 0.7 if room.front == "glass" else 0.0
    walls += [block(BUILDING, jamb, THICK_M, high, side * (wide - jamb) / 2, front, glass=glass) for side in (-1, 1)]
    if room.front == "closed":
        walls.append(block(BUILDING, DOOR_M, 0.05, high, y=front + 0.08))
    return tuple(walls)


def _shell(floor: Floor, count: int) -> list[Spot]:
    """Outer walls and ceiling of the floor. The wall at x = 0 is partly glass."""
    low, high = -(MORE + 0.5) * floor.pitch_m, (count + MORE - 0.5) * floor.pitch_m
    x, y, wide, half = floor.run_m / 2, (low + high) / 2, high - low, floor.half_m
    long, away = floor.run_m + 2 * half, floor.run_m / 2 + half + THICK_M / 2
    walls = [
        block(BUILDING, THICK_M, wide, floor.height_m, -away, glass=0.6),
        block(BUILDING, THICK_M, wide, floor.height_m, away),
        *(block(BUILDING, long, THICK_M, floor.height_m, y=side * wide / 2) for side in (-1, 1)),
    ]
    ceiling = block(BUILDING, long, wide, 0.3, bottom=floor.height_m)
    return [Spot((part,), x, y) for part in (*walls, ceiling)]
