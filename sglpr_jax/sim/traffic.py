"""Moving things: oncoming and other traffic, riders and pedestrians, as short pieces of straight motion."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from sglpr_jax.sim import objects
from sglpr_jax.sim.objects import ObjectModel, Range
from sglpr_jax.sim.placement import CLEARANCE_M, Spot, footprint_distance
from sglpr_jax.sim.streets import MIDDLE_M, Network, Path

KEPT_M = 8.0  # minimum distance of traffic ahead of the vehicle or behind it, in metres

_VIEW_M = 85.0
_PIECE_M, _PIECE_S = 7.0, (0.4, 1.0)
"""Approximate length of a piece of straight motion in metres, and range of its duration in seconds."""

LaneName = Literal["oncoming", "own", "left walk", "right walk"]


@dataclasses.dataclass(frozen=True)
class Flow:
    """One kind of traffic. The vehicle meets one such thing per `every_m` metres."""

    make: Callable[[np.random.Generator], ObjectModel]
    every_m: float
    lanes: tuple[LaneName, ...]
    speed: Range  # m/s relative to the ground; not used in the vehicle's own lane


_DRIVING, _RIDING, _WALKING = (5.0, 12.0), (3.0, 5.5), (0.9, 1.6)
FLOWS = (
    Flow(objects.car, 80.0, ("oncoming",), _DRIVING),
    Flow(objects.van, 500.0, ("oncoming",), _DRIVING),
    Flow(objects.truck, 300.0, ("oncoming",), _DRIVING),
    Flow(objects.bus, 1200.0, ("oncoming",), _DRIVING),
    Flow(objects.motorcyclist, 300.0, ("oncoming",), _DRIVING),
    Flow(objects.car, 350.0, ("own",), _DRIVING),
    Flow(objects.van, 1500.0, ("own",), _DRIVING),
    Flow(objects.bicyclist, 200.0, ("left walk", "right walk"), _RIDING),
    Flow(objects.person, 45.0, ("left walk", "right walk"), _WALKING),
)


Lane = tuple[np.ndarray, np.ndarray]
"""Position (n, 2) in metres, and whether the lane can be used, for each point of the path."""


def lanes(network: Network, path: Path) -> dict[LaneName, Lane]:
    """Lanes of the traffic relative to the vehicle: the oncoming lane, its own lane, and the sidewalks."""
    nearest = network.nearest(path.xy)
    half_width, stretch = network.half_width[nearest], network.stretch[nearest]
    forward = np.cos(path.heading - network.heading[nearest])  # -1 against the direction of the street
    to_middle = -network.offset(path.xy, nearest) * np.sign(forward)
    to_middle = np.where(np.abs(forward) > 0.9, to_middle.clip(-3, 4), MIDDLE_M)
    sizes = np.array(
        [
            [(side.strips[-1].width if side.strips else 0.0, side.verge, side.median) for side in part.sides]
            for part in network.stretches
        ]
    )  # (stretches, 2, 3): width of the last strip, of all strips and of the median
    left, right = sizes[stretch, (forward < 0).astype(int)], sizes[stretch, (forward > 0).astype(int)]
    median, everywhere = left[:, 2], np.ones(len(stretch), bool)
    beyond = np.where(median > 0, half_width + median + 3.5, half_width - 1.55)
    offsets: dict[LaneName, Lane] = {
        "own": (np.zeros(len(stretch)), everywhere),
        "oncoming": (to_middle + beyond, everywhere),
    }
    walks: tuple[tuple[LaneName, int, np.ndarray], ...] = ("left walk", 1, left), ("right walk", -1, right)
    for name, sign, side in walks:
        sidewalk, verge, _ = side.T
        offset = half_width + verge - np.where(sidewalk > 0, sidewalk / 2, -0.8)
        offsets[name] = to_middle + sign * offset, sidewalk > 0.9
    return {
        name: (path.xy + gaussian_filter1d(offset, 5.0, mode="nearest")[:, None] * path.left, usable)
        for name, (offset, usable) in offsets.items()
    }


def traffic(rng: np.random.Generator, network: Network, path: Path) -> list[Spot]:
    """Draws the traffic around the vehicle, clear of it."""
    lines = lanes(network, path)
    return [spot for flow in FLOWS for spot in _movers(rng, flow, lines, path)]


def _movers(rng: np.random.Generator, flow: Flow, lines: dict[LaneName, Lane], path: Path) -> Iterator[Spot]:
    """Yields the pieces of all movers of one flow. The vehicle meets each mover at another point of the path."""
    for block in np.arange(rng.uniform(-0.5, 0) * flow.every_m, len(path.xy), flow.every_m):
        meeting_m, name = block + rng.uniform(0, flow.every_m), flow.lanes[rng.integers(len(flow.lanes))]
        thing, speed = objects.moving(flow.make(rng)), rng.uniform(*flow.speed)
        direction, gap_m = int(rng.choice((-1, 1))), rng.choice((-1, 1)) * rng.uniform(14, 35)
        if not 0 <= meeting_m < len(path.xy) or not lines[name][1][int(meeting_m)]:
            continue
        ego = path.speed[int(meeting_m)]
        if name == "own":
            duration = rng.uniform(10, 30)
            times = path.times[int(meeting_m)] + np.arange(0, duration, 1.0)
            along = np.interp(times, path.times, np.arange(len(path.xy))) + gap_m
            direction = 1
        else:
            if name == "oncoming":
                direction, speed = -1, max(speed, 0.9 * ego)
            duration = _VIEW_M / max(speed + ego, 5.0)
            step = float(np.clip(_PIECE_M / speed, *_PIECE_S))
            offsets = np.arange(-duration, duration, step)
            times, along = path.times[int(meeting_m)] + offsets, meeting_m + direction * speed * offsets
        yield from _pieces(thing, lines[name][0], path, times, along, direction)


def _pieces(
    thing: ObjectModel,
    lane: Float[np.ndarray, "n 2"],
    path: Path,
    times: Float[np.ndarray, " k"],
    along: Float[np.ndarray, " k"],
    direction: int,
) -> list[Spot]:
    """Straight motions of a thing `along` metres along the path at `times`, on the lane and clear of the vehicle."""
    inside = (along[:-1] >= 0) & (along[1:] >= 0) & (np.maximum(along[:-1], along[1:]) <= len(path.xy) - 1)
    index = np.arange(len(path.xy))
    xy = np.stack([np.interp(along, index, axis) for axis in lane.T], axis=1)
    middle = (along[:-1] + along[1:]) / 2
    heading = np.interp(middle, index, path.heading) + (np.pi if direction < 0 else 0.0)
    pieces = (xy[:-1][inside], xy[1:][inside], heading[inside], times[:-1][inside], times[1:][inside])
    clear = _clear(thing, pieces, path)
    begin, end, heading, since, until = (leaf[clear] for leaf in pieces)
    velocity = (end - begin) / (until - since)[:, None]
    rows = np.column_stack([(begin + end) / 2, heading, velocity, since, until, (since + until) / 2]).tolist()
    return [Spot(thing, x, y, turn, 1, (vx, vy), *when) for x, y, turn, vx, vy, *when in rows]


def _clear(thing: ObjectModel, pieces: tuple[np.ndarray, ...], path: Path) -> Bool[np.ndarray, " k"]:
    """Whether each piece stays clear of the vehicle: CLEARANCE_M beside it, KEPT_M ahead of it and behind."""
    begin, end, heading, since, until = pieces
    half = np.max([(abs(part.x) + part.size[0] / 2, part.size[1] / 2, 0.0) for part in thing], axis=0)
    half = np.tile(half, (len(heading), 1))
    clear = np.ones(len(heading), bool)
    for share in np.linspace(0, 1, 21):
        time = since + share * (until - since)
        vehicle = np.stack([np.interp(time, path.times, axis) for axis in path.xy.T], axis=1)
        facing = np.interp(time, path.times, path.heading)
        away = vehicle - (begin + share * (end - begin))
        beside = np.abs(np.cos(facing) * away[:, 1] - np.sin(facing) * away[:, 0]) > half[:, 1] + 1.0
        distance = footprint_distance(away, heading, half)
        clear &= distance > np.where(beside, CLEARANCE_M, KEPT_M)
    return clear
