"""Moving objects: oncoming and other traffic, riders and pedestrians, as short pieces of straight motion."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from sglpr_jax.sim import objects
from sglpr_jax.sim.objects import ObjectModel, Range
from sglpr_jax.sim.placement import CLEARANCE_M, Spot, footprint_distance, moving_spots
from sglpr_jax.sim.streets import MIDDLE_M, Network, Path
from sglpr_jax.sim.styles import Side

KEPT_M = 8.0  # minimum distance of traffic ahead of the vehicle or behind it, in metres

_VIEW_M = 85.0  # approximate distance between vehicle and mover when the mover appears and disappears, in metres
_PIECE_M, _PIECE_S = 7.0, (0.4, 1.0)
"""Approximate length of a piece of straight motion in metres, and range of its duration in seconds."""

LaneName = Literal["oncoming", "own", "left walk", "right walk"]


@dataclasses.dataclass(frozen=True)
class Flow:
    """One kind of traffic. The vehicle meets one such object per `every_m` metres."""

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
    alignment = np.cos(path.heading - network.heading[nearest])  # 1 along the direction of the street, -1 against it
    to_middle = -network.offset(path.xy, nearest) * np.sign(alignment)
    to_middle = np.where(np.abs(alignment) > 0.9, to_middle.clip(-3, 4), MIDDLE_M)  # MIDDLE_M at crossings
    # Shape (stretches, 2, 3): for each side, the width of the last strip, of all strips and of the median.
    strip_widths = np.array([[_strip_widths(side) for side in stretch.sides] for stretch in network.stretches])
    left = strip_widths[stretch, (alignment < 0).astype(int)]
    right = strip_widths[stretch, (alignment > 0).astype(int)]
    median, everywhere = left[:, 2], np.ones(len(stretch), bool)
    from_middle = np.where(median > 0, half_width + median + 3.5, half_width - 1.55)
    offsets: dict[LaneName, Lane] = {
        "own": (np.zeros(len(stretch)), everywhere),
        "oncoming": (to_middle + from_middle, everywhere),
    }
    walks: tuple[tuple[LaneName, int, np.ndarray], ...] = ("left walk", 1, left), ("right walk", -1, right)
    for name, sign, side_widths in walks:
        sidewalk, verge, _ = side_widths.T
        offset = half_width + verge - np.where(sidewalk > 0, sidewalk / 2, -0.8)
        offsets[name] = to_middle + sign * offset, sidewalk > 0.9
    return {
        name: (path.xy + gaussian_filter1d(offset, 5.0, mode="nearest")[:, None] * path.left, is_usable)
        for name, (offset, is_usable) in offsets.items()
    }


def _strip_widths(side: Side) -> tuple[float, float, float]:
    """Width of the last strip, of all strips and of the median of one side of a street, in metres."""
    return side.strips[-1].width if side.strips else 0.0, side.verge, side.median


def traffic(rng: np.random.Generator, network: Network, path: Path) -> list[Spot]:
    """Draws the traffic around the vehicle, clear of it."""
    all_lanes = lanes(network, path)
    return [spot for flow in FLOWS for spot in _movers(rng, flow, all_lanes, path)]


def _movers(rng: np.random.Generator, flow: Flow, lanes: dict[LaneName, Lane], path: Path) -> Iterator[Spot]:
    """Yields the pieces of all movers of one flow. The vehicle meets each mover at another point of the path."""
    for block_start_m in np.arange(rng.uniform(-0.5, 0) * flow.every_m, len(path.xy), flow.every_m):
        meeting_m, lane_name = block_start_m + rng.uniform(0, flow.every_m), flow.lanes[rng.integers(len(flow.lanes))]
        thing, speed = objects.moving(flow.make(rng)), rng.uniform(*flow.speed)
        direction, gap_m = int(rng.choice((-1, 1))), rng.choice((-1, 1)) * rng.uniform(14, 35)
        if not 0 <= meeting_m < len(path.xy):
            continue
        lane, is_usable = lanes[lane_name]
        meeting = int(meeting_m)  # index of the path's point, because points are 1 m apart
        if not is_usable[meeting]:
            continue
        vehicle_speed = path.speed[meeting]
        if lane_name == "own":  # the mover drives `gap_m` ahead of the vehicle, or behind it if `gap_m` is negative
            duration = rng.uniform(10, 30)
            times = path.times[meeting] + np.arange(0, duration, 1.0)
            along_m = np.interp(times, path.times, np.arange(len(path.xy))) + gap_m
            direction = 1
        else:
            if lane_name == "oncoming":
                direction, speed = -1, max(speed, 0.9 * vehicle_speed)
            duration = _VIEW_M / max(speed + vehicle_speed, 5.0)
            time_step = float(np.clip(_PIECE_M / speed, *_PIECE_S))
            since_meeting = np.arange(-duration, duration, time_step)
            times, along_m = path.times[meeting] + since_meeting, meeting_m + direction * speed * since_meeting
        yield from _pieces(thing, lane, path, times, along_m, direction)


def _pieces(
    thing: ObjectModel,
    lane: Float[np.ndarray, "n 2"],
    path: Path,
    times: Float[np.ndarray, " k"],
    along_m: Float[np.ndarray, " k"],
    direction: int,
) -> list[Spot]:
    """Straight motions of `thing` on a lane, between positions `along_m` the path at `times`.

    Pieces beyond the ends of the path or too close to the vehicle are omitted.
    """
    before, after = along_m[:-1], along_m[1:]
    on_path = (before >= 0) & (after >= 0) & (np.maximum(before, after) <= len(path.xy) - 1)
    index = np.arange(len(path.xy))
    xy = np.stack([np.interp(along_m, index, axis) for axis in lane.T], axis=1)
    heading = np.interp((before + after) / 2, index, path.heading) + (np.pi if direction < 0 else 0.0)
    pieces = (xy[:-1][on_path], xy[1:][on_path], heading[on_path], times[:-1][on_path], times[1:][on_path])
    is_clear = _is_clear_of_vehicle(thing, pieces, path)
    return moving_spots(thing, *(column[is_clear] for column in pieces))


def _is_clear_of_vehicle(thing: ObjectModel, pieces: tuple[np.ndarray, ...], path: Path) -> Bool[np.ndarray, " k"]:
    """Whether each piece stays clear of the vehicle: CLEARANCE_M beside it, KEPT_M ahead of it and behind.

    `pieces` holds first and last position, heading, first and last time of the pieces.
    """
    begin, end, heading, since, until = pieces
    half = np.max([(abs(part.x) + part.size[0] / 2, part.size[1] / 2, 0.0) for part in thing], axis=0)
    half = np.tile(half, (len(heading), 1))
    is_clear = np.ones(len(heading), bool)
    for fraction in np.linspace(0, 1, 21):  # of the piece's duration
        time = since + fraction * (until - since)
        vehicle_xy = np.stack([np.interp(time, path.times, axis) for axis in path.xy.T], axis=1)
        vehicle_heading = np.interp(time, path.times, path.heading)
        offset = vehicle_xy - (begin + fraction * (end - begin))
        left = np.cos(vehicle_heading) * offset[:, 1] - np.sin(vehicle_heading) * offset[:, 0]
        is_beside = np.abs(left) > half[:, 1] + 1.0
        is_clear &= footprint_distance(offset, heading, half) > np.where(is_beside, CLEARANCE_M, KEPT_M)
    return is_clear
