"""Objects along one side of a street: on the strips beside the road, and on the plots behind the strips.

Spots are in the frame of the side: x is the distance s along the street, y the distance d outwards from the kerb.
"""

import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from sglpr_jax.sim import objects
from sglpr_jax.sim.labels import FENCE, OTHER_OBJECT, POLE, TERRAIN, TRAFFIC_SIGN
from sglpr_jax.sim.objects import ObjectModel, Primitive, Range
from sglpr_jax.sim.placement import Spot, Zone
from sglpr_jax.sim.styles import Side, draw_house

Clock = tuple[float, float]
"""Start and end of a period, such as the drive, in seconds."""
STAY_S = 600.0  # mean time that a parked car stays, in seconds
CHANGING_BUSHES = 0.1  # fraction of the bushes that are present for a while: growth and cutting


def frontage(
    rng: np.random.Generator, side: Side, start: float, stop: float, clock: Clock, bystanders: Iterator[Callable]
) -> Iterator[Spot]:
    """Yields the objects along one side of a street, from s = `start` to `stop`, in metres.

    Spots have x = s along the street and y = d outwards from the kerb. `bystanders` yields functions that make people
    and similar objects. Some objects are present only for part of the drive, which lasts for `clock`.
    """
    if side.bays:
        d = side.strips[0].width / 2 + 0.1
        for s in _spaced_positions(rng, start + 4, stop - 4, (5.4, 6.4)):
            bay = Spot((), s, d, rng.choice((0.0, np.pi)), zone="bay")
            yield from _successive_objects(rng, objects.parked, bay, clock, side.occupied)
    yield from _street_furniture(rng, side, start, stop)
    yield from _tree_row(rng, side, start, stop)
    for s in _poisson_positions(rng, side.style.bystanders, start, stop):
        d = side.verge - rng.uniform(0.3, max(side.strips[-1].width, 0.6) if side.strips else 0.6)
        make = next(bystanders)
        if side.style.groups and make is objects.person:
            make = objects.people
        spot = Spot((), s, d, rng.choice((0.0, np.pi)) + rng.normal(0, 0.2), zone="verge")
        yield from _successive_objects(rng, make, spot, clock, 0.65)
    if side.wood:
        yield from _wood(rng, side, start, stop)
    elif side.bank:
        yield from _banks(rng, side, start, stop)
    elif side.slope:
        yield from _slope(rng, side, start, stop)
    else:
        yield from _border(rng, side, start, stop)
        yield from _plots(rng, side, start, stop, clock)
    yield from _greenery(rng, side, start, stop, clock)


def _spaced_positions(rng: np.random.Generator, start: float, stop: float, spacing: Range) -> Iterator[float]:
    """Yields positions from `start` to `stop` with distances in the range `spacing`, in metres."""
    position = start + rng.uniform(0, spacing[1])
    while position < stop:
        yield position
        position += rng.uniform(*spacing)


def _poisson_positions(rng: np.random.Generator, per_metre: float, start: float, stop: float) -> list[float]:
    """Random positions from `start` to `stop`, on average `per_metre` per metre."""
    return rng.uniform(start, stop, rng.poisson(per_metre * (stop - start))).tolist()


def stays(rng: np.random.Generator, clock: Clock, occupied: float) -> Iterator[Clock]:
    """Yields start and end of the stays at a place that is occupied for the fraction `occupied` of the time.

    If the place is occupied at the start of `clock`, the first stay begins at -inf.
    """
    time = clock[0]
    is_occupied = rng.random() < occupied
    while time < clock[1]:
        duration = rng.exponential(STAY_S if is_occupied else STAY_S * (1 - occupied) / occupied)
        if is_occupied:
            yield (-np.inf if time == clock[0] else time, time + duration)
        time += duration
        is_occupied = not is_occupied


def _successive_objects(
    rng: np.random.Generator,
    make: Callable[[np.random.Generator], ObjectModel],
    spot: Spot,
    clock: Clock,
    occupied: float,
) -> Iterator[Spot]:
    """Yields the objects that occupy `spot` one after another, for the fraction `occupied` of the time."""
    for since, until in stays(rng, clock, occupied):
        (dx, dy), turn = rng.normal(0, 0.15, 2), rng.normal(0, 0.03)
        pose = {"x": spot.x + dx, "y": spot.y + dy / 2, "heading": spot.heading + turn}
        yield spot._replace(thing=make(rng), **pose, since=since, until=until)


def _street_furniture(rng: np.random.Generator, side: Side, start: float, stop: float) -> Iterator[Spot]:
    """Lamp posts, bins, benches, posts and signs at the edge of the sidewalk nearest to the road."""
    d = side.verge - side.strips[-1].width + 0.35 if side.strips else 0.7
    zone: Zone = "verge" if side.strips else "plot"
    if side.style.lamps:
        spacing = rng.uniform(20, 40)
        for s in _spaced_positions(rng, start, stop, (spacing, spacing + 3)):
            yield Spot((objects.post(POLE, 0.18, rng.uniform(5, 8)),), s, d, zone=zone)
        for s in _spaced_positions(rng, start, stop, (40.0, 120.0)):
            yield Spot(_bin_or_bench(rng), s, d + 0.3, zone=zone)
    if side.post_spacing:
        for s in _spaced_positions(rng, start, stop, (side.post_spacing, side.post_spacing + 0.2)):
            yield Spot((objects.post(POLE, 0.15, 1.4),), s, d, zone=zone)
    for s in _poisson_positions(rng, side.style.signs, start, stop):
        size, bottom = rng.uniform(0.5, 0.9), rng.uniform(1.3, 2.1)
        plate = objects.block(TRAFFIC_SIGN, 0.06, size, size, x=0.06, bottom=bottom)
        yield Spot((objects.post(POLE, 0.08, bottom + size), plate), s, d, rng.normal(0, 0.2), zone=zone)


def _tree_row(rng: np.random.Generator, side: Side, start: float, stop: float) -> Iterator[Spot]:
    """Street trees, on the median if the street has one. The median of a highway has a guard rail instead.

    Distances are from the edge of the road, outwards. `side.verge` is the distance of the outer edge of the last strip,
    and trees stand 0.5 m behind the inner edge of this strip.
    """
    if side.median and side.border == "rail":
        yield from _border_pieces(rng, "rail", start, stop, side.median / 2, "verge")
        return
    if not side.tree_spacing:
        return
    distances = [side.verge - side.strips[-1].width + 0.5] if side.strips else [1.2]  # one for each row of trees
    if side.median:
        distances = [side.median / 2] if side.median < 5 else [1.3, side.median - 1.3]
    for d in distances:
        for s in _spaced_positions(rng, start + 2, stop - 2, (side.tree_spacing, side.tree_spacing + 1)):
            spread = (2.0, 4.0) if side.median or side.strips else (3.0, 7.0)
            yield Spot(_tree(rng, side, spread), s, d, zone="verge" if side.strips else "plot")


def _tree(rng: np.random.Generator, side: Side, spread: Range) -> ObjectModel:
    return objects.limbed_tree(rng, spread) if side.style.old_trees else objects.tree(rng, spread)


class Border(NamedTuple):
    """Border of a plot: its sizes in metres, and the function that makes a piece of it along x."""

    thickness: float
    height: Range
    closed: float  # fraction of the line that is closed
    make: Callable[..., ObjectModel]  # of a random generator, length, thickness and height


def _wall(_: np.random.Generator, length: float, thickness: float, height: float, porosity: float = 0.0) -> ObjectModel:
    return (objects.block(FENCE, length, thickness, height + 0.3, bottom=-0.3, porosity=porosity),)


def _trimmed(rng: np.random.Generator, *size: float) -> ObjectModel:
    """Hedge that is straight and dense like a wall."""
    return objects.hedge(*size, roughness=rng.uniform(0.05, 0.2), porosity=rng.uniform(0.05, 0.25))


def _rail(rng: np.random.Generator, length: float, thickness: float, height: float) -> ObjectModel:
    beam = objects.block(FENCE, length, thickness, 0.35, bottom=height - 0.35)
    return beam, objects.post(FENCE, 0.12, height)


def _lattice(rng: np.random.Generator, length: float, thickness: float, height: float) -> ObjectModel:
    """Low see-through fence on posts, with a bush behind some pieces."""
    mesh = _wall(rng, length, thickness, height, rng.uniform(0.4, 0.8))
    parts = [*mesh, objects.block(FENCE, 0.15, 0.15, height + 0.1)]
    if rng.random() < 0.3:
        x, y = rng.uniform(-0.4, 0.4) * length, rng.uniform(0.7, 1.5)
        parts += [part._replace(x=part.x + x, y=part.y + y) for part in objects.bush(rng, 0.6)]
    return tuple(parts)


_BORDERS = {
    "hedge": Border(1.0, (0.9, 2.6), 0.9, lambda rng, *size: objects.hedge(*size)),
    "trimmed": Border(0.8, (0.9, 2.2), 0.9, _trimmed),
    "hedgerow": Border(0.3, (1.2, 3.0), 0.95, objects.hedgerow),
    "fence": Border(0.06, (0.9, 1.8), 0.85, lambda rng, *size: _wall(rng, *size, porosity=0.45)),
    "lattice": Border(0.08, (0.8, 1.5), 0.9, _lattice),
    "wall": Border(0.25, (0.7, 2.2), 0.9, _wall),
    "screen": Border(0.2, (1.6, 3.5), 1.0, _wall),
    "rail": Border(0.15, (0.75, 0.8), 1.0, _rail),
}


def _border_pieces(
    rng: np.random.Generator, border: str, start: float, stop: float, d: float, zone: Zone
) -> Iterator[Spot]:
    """Border along the street, in short pieces that follow curves and slopes."""
    kind = _BORDERS[border]
    height = rng.uniform(*kind.height)
    count = int((stop - start) / 5) + 1
    ends = np.linspace(start, stop, count + 1).tolist()
    for first, last in itertools.pairwise(ends):
        yield Spot(kind.make(rng, last - first + 0.1, kind.thickness, height), (first + last) / 2, d, zone=zone)


def _border(rng: np.random.Generator, side: Side, start: float, stop: float) -> Iterator[Spot]:
    """Border between the plots and the sidewalk, with entrances."""
    if side.border == "none":
        return
    border = _BORDERS[side.border]
    d = side.verge + 0.45 + border.thickness / 2
    s = start
    while s < stop - 1:
        end = stop if side.border == "rail" else min(s + rng.uniform(*side.style.closed), stop)
        if rng.random() < border.closed:
            yield from _border_pieces(rng, side.border, s, end, d, "plot")
        s = end + rng.uniform(2, 4.5)


def _plots(rng: np.random.Generator, side: Side, start: float, stop: float, clock: Clock) -> Iterator[Spot]:
    """Row of houses. Gaps between houses may hold cars, a garage, a wall or a hedge."""
    style = side.style
    s = start + max(rng.uniform(*style.gap), 0) / 2
    while s < stop - 3.5:
        house = side.row or draw_house(rng, style)
        width, gap = min(house.width, stop - s), rng.uniform(*style.gap)
        if rng.random() < style.houses:
            on_building_line = rng.random() < (1.0 if side.row else 0.75)
            set_back = side.set_back if on_building_line else rng.uniform(*style.set_back)
            thing = objects.house(rng, house._replace(width=width), porch=set_back > 2)
            yield Spot(thing, s + width / 2, side.verge + 0.1 + set_back, rng.normal(0, 0.008))
        if gap > 2.5 and s + width + gap < stop:
            yield from _between_houses(rng, s + width, side, gap, clock)
        s += width + gap


def _between_houses(rng: np.random.Generator, s: float, side: Side, gap: float, clock: Clock) -> Iterator[Spot]:
    """Cars, a garage, a hedge, a wall or nothing in a gap of `gap` metres that begins at `s`."""
    content = rng.choice(["cars", "garage", "hedge", "wall", "nothing"], p=[0.4, 0.2, 0.15, 0.1, 0.15])
    middle, d = s + gap / 2, side.verge
    if content == "cars":
        for car_s in np.arange(s + 1.4, s + min(gap, 14) - 1.2, 2.6).tolist():
            yield from _successive_objects(rng, objects.parked, Spot((), car_s, d + 4.5, np.pi / 2), clock, 0.6)
    elif content == "garage":
        yield Spot(objects.garage(rng, min(gap, rng.uniform(3, 7))), middle, d + rng.uniform(3, 9))
    elif content == "hedge":
        yield Spot(objects.hedge(9.0, 0.8, rng.uniform(1, 2.2)), middle, d + 6, np.pi / 2)
    elif content == "wall":
        yield Spot(_wall(rng, 9.0, 0.25, rng.uniform(1.2, 2.2)), middle, d + 6, np.pi / 2)


def _greenery(rng: np.random.Generator, side: Side, start: float, stop: float, clock: Clock) -> Iterator[Spot]:
    """Trees and bushes on the plots, most of them near the street."""
    for s in _poisson_positions(rng, side.style.trees, start, stop):
        d, quantile = side.verge + 1.0 + 14 * rng.random() ** 2, rng.random()
        if quantile < 0.28:
            yield Spot(_tree(rng, side, (3.0, 7.0)), s, d)
        elif quantile < 0.35:
            yield Spot(objects.conifer(rng), s, d)
        elif rng.random() < CHANGING_BUSHES:
            yield from _successive_objects(rng, objects.bush, Spot((), s, d), clock, 0.5)
        else:
            yield Spot(objects.bush(rng), s, d)


def _wood(rng: np.random.Generator, side: Side, start: float, stop: float) -> Iterator[Spot]:
    """Edge of a wood, three rows deep."""
    edge = side.verge + rng.uniform(2.5, 6)
    for row in range(3):
        for s in _spaced_positions(rng, start, stop, (3.0 + row, 5.5 + 2 * row)):
            yield Spot(objects.thicket(rng), s, edge + 4.5 * row + rng.uniform(0, 2), rng.uniform(0, 2 * np.pi))


def _banks(rng: np.random.Generator, side: Side, start: float, stop: float) -> Iterator[Spot]:
    """Banks beside the road, with bushes on them."""
    for s in _spaced_positions(rng, start, stop, (9.0, 14.0)):
        length, width, height = rng.uniform((16, 9, 1.5), (30, 16, 4.0)).tolist()
        bank = Primitive("ellipsoid", TERRAIN, (length, width, 2 * height), bottom=-height, roughness=0.02)
        bushes = [
            part._replace(x=part.x + rng.uniform(-0.3, 0.3) * length, bottom=part.bottom + 0.85 * height)
            for part in objects.bush(rng, 1.3)
        ]
        yield Spot((bank, *bushes), s, side.verge + 1 + width / 2)


def _slope(rng: np.random.Generator, side: Side, start: float, stop: float) -> Iterator[Spot]:
    """Foot of a hill: long, overlapping mounds that are mostly below the ground."""
    length, width, height, depth = rng.uniform((20, 16, 3.0, 0.3), (35, 50, 8.0, 0.8)).tolist()
    for s in _spaced_positions(rng, start, stop, (5.0, 7.0)):
        mound_width = width * rng.uniform(0.95, 1.05)
        size, bottom = (length, mound_width, 2 * height), -(1 + depth) * height  # the middle is `depth * height` deep
        mound = Primitive("ellipsoid", TERRAIN, size, bottom=bottom, roughness=0.05)
        yield Spot((mound,), s, side.verge + 1 + mound_width / 2)


def _bin_or_bench(rng: np.random.Generator) -> ObjectModel:
    return (objects.block(OTHER_OBJECT, *rng.uniform((0.5, 0.5, 0.8), (1.8, 0.8, 1.3)).tolist()),)


def bystanders(rng: np.random.Generator) -> Iterator[Callable[[np.random.Generator], ObjectModel]]:
    """Yields functions that draw a bystander, without end. Of ten, three draw people and three draw bicycles."""
    makers = [objects.person, objects.person, objects.person, objects.bicycle, objects.bicycle, objects.bicycle]
    makers += [objects.bicyclist, objects.motorcycle, objects.motorcyclist, _bin_or_bench]
    while True:
        for i in rng.permutation(len(makers)).tolist():
            yield makers[i]
