"""What stands along one side of a block of houses, as the street shows it.

Everything is placed in the side's own frame: s runs along the kerb from one corner to the next, d leads away from the
road, z up. Five styles of block and a few random numbers per side make one street differ from the next.
"""

import dataclasses
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

CAR, BICYCLE, TRUCK, VAN, PERSON, BICYCLIST = 10, 11, 18, 20, 30, 31
ROAD, PARKING, SIDEWALK, BUILDING, FENCE, VEGETATION = 40, 44, 48, 50, 51, 70
TRUNK, TERRAIN, POLE, TRAFFIC_SIGN = 71, 72, 80, 81
BAY_M = 2.3
"""Depth of a parking bay."""

Range = tuple[float, float]


class Item(NamedTuple):
    """One shape in the frame of its side; metres and radians."""

    kind: Literal["box", "cylinder", "ellipsoid"]
    label: int
    s: float
    d: float
    bottom: float
    length: float  # along s before the yaw
    width: float
    height: float
    yaw: float = 0.0
    roughness: float = 0.0


@dataclasses.dataclass(frozen=True)
class Style:
    """How one kind of block is built; every pair is the range of a uniform distribution, in metres."""

    width: Range
    depth: Range
    height: Range
    gap: Range
    set_back: Range
    garden: int  # label of the ground around the houses
    border: tuple[str, ...]  # what may close off the front; one is drawn per side
    parking: float  # probability that a block has parking bays
    greenery: float  # trees and bushes per metre of side
    houses: float  # probability that a plot is built on


STYLES = {
    "centre": Style(
        width=(9.0, 22.0),
        depth=(8.0, 13.0),
        height=(9.0, 18.0),
        gap=(-2.0, 0.5),
        set_back=(0.0, 1.5),
        garden=SIDEWALK,
        border=("none",),
        parking=0.6,
        greenery=0.05,
        houses=0.9,
    ),
    "suburb": Style(
        width=(8.0, 14.0),
        depth=(7.0, 11.0),
        height=(4.0, 8.0),
        gap=(3.0, 11.0),
        set_back=(3.0, 8.0),
        garden=TERRAIN,
        border=("hedge", "hedge", "fence", "wall", "none", "none"),
        parking=0.3,
        greenery=0.35,
        houses=1.0,
    ),
    "estate": Style(
        width=(18.0, 38.0),
        depth=(10.0, 13.0),
        height=(8.0, 13.0),
        gap=(8.0, 20.0),
        set_back=(4.0, 10.0),
        garden=TERRAIN,
        border=("none", "none", "hedge"),
        parking=0.5,
        greenery=0.25,
        houses=1.0,
    ),
    "works": Style(
        width=(16.0, 40.0),
        depth=(12.0, 20.0),
        height=(5.0, 9.0),
        gap=(6.0, 18.0),
        set_back=(3.0, 10.0),
        garden=PARKING,
        border=("fence", "wall", "hedge"),
        parking=0.2,
        greenery=0.08,
        houses=1.0,
    ),
    "park": Style(
        width=(6.0, 9.0),
        depth=(4.0, 6.0),
        height=(3.0, 4.0),
        gap=(20.0, 40.0),
        set_back=(8.0, 15.0),
        garden=TERRAIN,
        border=("none", "none", "hedge", "fence"),
        parking=0.2,
        greenery=0.6,
        houses=0.3,
    ),
}


@dataclasses.dataclass(frozen=True)
class Verge:
    """The strip between the kerb and the plots of a block."""

    bay: float  # depth of the parking bays; 0 where there are none
    walk: float  # width of the sidewalk

    @property
    def depth(self) -> float:
        return self.bay + self.walk


def draw_verge(rng: np.random.Generator, style: Style) -> Verge:
    """Draw the parking bays and the sidewalk around a block."""
    return Verge(BAY_M if rng.random() < style.parking else 0.0, rng.uniform(1.5, 3.5))


def frontage(rng: np.random.Generator, style: Style, verge: Verge, length: float) -> Iterator[Item]:
    """Yield all that stands along one side of `length` metres between its two corners."""
    if verge.bay:
        yield from _parked_cars(rng, verge.bay / 2, length)
    yield from _street_furniture(rng, verge, length)
    yield from _passers_by(rng, verge, length)
    yield from _border(rng, style, verge, length)
    yield from _plots(rng, style, verge, length)
    for _ in range(rng.poisson(style.greenery * length)):
        s, d = rng.uniform(verge.depth + 2, length - verge.depth - 2), verge.depth + 0.8 + 12 * rng.random() ** 2
        yield from _tree(rng, s, d, (2.5, 6.0)) if rng.random() < 0.5 else _bush(rng, s, d)


def _steps(rng: np.random.Generator, start: float, stop: float, spacing: Range) -> Iterator[float]:
    """Yield places from `start` to `stop`, randomly spaced."""
    place = start + rng.uniform(0, spacing[1])
    while place < stop:
        yield place
        place += rng.uniform(*spacing)


def _car(rng: np.random.Generator, s: float, d: float, yaw: float) -> Iterator[Item]:
    yaw += rng.normal(0, 0.03)
    kind = rng.choice(["car", "van", "truck"], p=[0.9, 0.07, 0.03])
    if kind == "car":
        length, height = rng.uniform(3.6, 4.8), rng.uniform(1.35, 1.65)
        yield Item("box", CAR, s, d, 0.2, length, 1.75, 0.6 * height, yaw)
        yield Item("box", CAR, s, d, 0.2, 0.55 * length, 1.5, height - 0.2, yaw)
    elif kind == "van":
        yield Item("box", VAN, s, d, 0.25, rng.uniform(4.8, 5.6), 1.95, rng.uniform(1.8, 2.4), yaw)
    else:
        yield Item("box", TRUCK, s, d, 0.4, rng.uniform(6, 8), 2.1, rng.uniform(2.6, 3.3), yaw)


def _parked_cars(rng: np.random.Generator, d: float, length: float) -> Iterator[Item]:
    occupied = rng.uniform(0.15, 0.95)
    for s in _steps(rng, 7.0, length - 7, (5.6, 6.4)):
        if rng.random() < occupied:
            yield from _car(rng, s, d, 0.0)


def _tree(rng: np.random.Generator, s: float, d: float, spread: Range) -> Iterator[Item]:
    """A trunk under a crown whose diameter is in the range `spread`."""
    trunk, crown = rng.uniform(0.25, 0.7), rng.uniform(*spread)
    below = rng.uniform(1.2, 2.6)
    yield Item("cylinder", TRUNK, s, d, 0, trunk, trunk, below + 0.3 * crown)
    yield Item("ellipsoid", VEGETATION, s, d, below, crown, crown, crown * rng.uniform(0.8, 1.4), roughness=0.5)


def _bush(rng: np.random.Generator, s: float, d: float) -> Iterator[Item]:
    length, width, height = rng.uniform(0.8, 3.5), rng.uniform(0.8, 2), rng.uniform(0.6, 2.6)
    yield Item("ellipsoid", VEGETATION, s, d, -0.3 * height, length, width, 1.3 * height, rng.uniform(0, np.pi), 0.15)


def _street_furniture(rng: np.random.Generator, verge: Verge, length: float) -> Iterator[Item]:
    """Lamp posts, signs and, along some sides, a row of trees."""
    d = verge.bay + 0.4
    lamps = rng.uniform(18, 40)
    for s in _steps(rng, 2.0, length - 2, (lamps, lamps + 3)):
        yield Item("cylinder", POLE, s, d, 0, 0.2, 0.2, rng.uniform(5, 8))
    for s in _steps(rng, 2.0, length - 2, (12.0, 50.0)):
        side = rng.uniform(0.5, 0.8)
        yield Item("cylinder", POLE, s, d, 0, 0.09, 0.09, 2.3)
        yield Item("box", TRAFFIC_SIGN, s, d, 2.0, 0.06, side, side, rng.normal(0, 0.2))
    if verge.walk > 2 and rng.random() < 0.4:
        spacing = rng.uniform(7, 16)
        for s in _steps(rng, 4.0, length - 4, (spacing, spacing + 1)):
            yield from _tree(rng, s, d + 0.3, (1.8, 3.4))  # small: the vehicle passes beside it


def _passers_by(rng: np.random.Generator, verge: Verge, length: float) -> Iterator[Item]:
    """People, riders and parked bicycles on the sidewalk."""
    for s in rng.uniform(2, length - 2, rng.poisson(length / 60)):
        d, height = verge.bay + rng.uniform(0.6, verge.walk), rng.uniform(1.5, 1.9)
        what = rng.choice(["person", "bicyclist", "bicycle"], p=[0.5, 0.2, 0.3])
        if what == "person":
            yield Item("cylinder", PERSON, s, d, 0, 0.5, 0.35, height)
            continue
        yield Item("box", BICYCLIST if what == "bicyclist" else BICYCLE, s, d, 0, 1.7, 0.12, 1.0)
        if what == "bicyclist":
            yield Item("cylinder", BICYCLIST, s, d, 0.6, 0.4, 0.45, height - 0.4)


def _border(rng: np.random.Generator, style: Style, verge: Verge, length: float) -> Iterator[Item]:
    """What closes the plots off from the sidewalk, in pieces with entrances between them."""
    label, thickness, low, high, roughness = {
        "none": (FENCE, 0, 0, 0, 0),
        "hedge": (VEGETATION, 0.8, 0.9, 2.2, 0.12),
        "fence": (FENCE, 0.06, 0.9, 1.8, 0.03),
        "wall": (FENCE, 0.25, 0.6, 2.0, 0.0),
    }[rng.choice(style.border)]
    if not thickness:
        return
    s, end = verge.depth, length - verge.depth
    while s < end:
        piece = min(rng.uniform(5, 22), end - s)
        if rng.random() < 0.85:
            d = verge.depth + 0.2 + thickness / 2
            yield Item("box", label, s + piece / 2, d, 0, piece, thickness, rng.uniform(low, high), 0, roughness)
        s += piece + rng.uniform(2, 5)


def _plots(rng: np.random.Generator, style: Style, verge: Verge, length: float) -> Iterator[Item]:
    """The row of houses; some have a lower wing, some gaps hold a car, a shed or a hedge between neighbours."""
    s, end = verge.depth + rng.uniform(*style.set_back), length - verge.depth - 2
    row = rng.uniform(*style.set_back)  # the row's common building line
    while s < end:
        width, depth, gap = rng.uniform(*style.width), rng.uniform(*style.depth), rng.uniform(*style.gap)
        width = min(width, end - s)
        if rng.random() < style.houses and width > 3:
            set_back = row if rng.random() < 0.7 else rng.uniform(*style.set_back)
            yield from _house(rng, s, verge.depth + set_back, width, depth, rng.uniform(*style.height))
        if gap > 2.5 and s + width + gap < end:
            yield from _between_houses(rng, s + width, verge.depth, gap)
        s += width + gap


def _house(rng: np.random.Generator, s: float, d: float, width: float, depth: float, height: float) -> Iterator[Item]:
    """A house whose front begins at (s, d)."""
    yield Item("box", BUILDING, s + width / 2, d + depth / 2, 0, width, depth, height, rng.normal(0, 0.01))
    if rng.random() < 0.5:  # a wing or a porch in front of the house, or set back beside it
        wing, forward = rng.uniform(0.2, 0.5) * width, rng.uniform(-1.5, 1.5)
        at = s + wing / 2 + rng.uniform(0, width - wing)
        yield Item("box", BUILDING, at, d + depth / 2 - forward, 0, wing, depth, rng.uniform(0.5, 0.85) * height)


def _between_houses(rng: np.random.Generator, s: float, d: float, gap: float) -> Iterator[Item]:
    what = rng.choice(["car", "shed", "hedge", "nothing"], p=[0.35, 0.2, 0.2, 0.25])
    if what == "car":
        yield from _car(rng, s + gap / 2, d + rng.uniform(3, 6), np.pi / 2)
    elif what == "shed":
        yield Item("box", BUILDING, s + gap / 2, d + rng.uniform(8, 11), 0, min(gap, 4), 5, rng.uniform(2.2, 3))
    elif what == "hedge":
        yield Item("box", VEGETATION, s + gap / 2, d + 6, 0, 0.8, 11, rng.uniform(1, 2.2), roughness=0.12)
