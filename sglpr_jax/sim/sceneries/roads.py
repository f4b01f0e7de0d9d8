"""Roads along which the same objects repeat: between two walls, through a tunnel, a highway, and a bridge."""

import numpy as np

from sglpr_jax.sim.drive import shifted
from sglpr_jax.sim.labels import (
    BUILDING,
    FENCE,
    LANE_MARKING,
    NO_RETURN,
    OTHER_OBJECT,
    POLE,
    ROAD,
    TERRAIN,
    TRAFFIC_SIGN,
)
from sglpr_jax.sim.objects import ObjectModel, block, car, moving, post, truck, van
from sglpr_jax.sim.placement import Spot, moving_spots
from sglpr_jax.sim.routes import Line
from sglpr_jax.sim.sceneries.site import STEP_M, PaintedStrip, Site, along, mirrored, painted_ground, road, rolling

OVERLAP = 1.25  # length of a piece of wall divided by the spacing, because outer walls of curves are longer
LANE_M = 3.5  # width of the four lanes of a highway, in metres; the vehicle uses the inner ones
TUNNEL_M, NICHE_M = 6.0, 1.3  # length of a piece of a tunnel, and depth of its niches, in metres
THICK_M = 2.0
"""Thickness of a tunnel's walls, in metres. It exceeds the depth of a niche, so neighbouring pieces close its sides."""


def walls(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Road between two walls without features."""
    road_line, path = road(rng, length_m, closed)
    left, right, height = rng.uniform(3.5, 8), rng.uniform(3, 7), rng.uniform(1.8, 4)
    pair = tuple(block(FENCE, OVERLAP * 4.0, 0.4, height, y=y, roughness=0.02) for y in (left + 0.2, -right - 0.2))
    return Site(path, along(road_line, (pair, 4.0)), painted_ground(ROAD))


def tunnel(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Tunnel of equal pieces of length TUNNEL_M with lamps. Every n-th piece has an emergency niche on the right."""
    road_line, path = road(rng, length_m, closed)
    half, height, niche_every = rng.uniform(3.8, 5.5), rng.uniform(4.8, 6.5), int(rng.integers(7, 16))
    pieces = along(road_line, (_tube(half, height, 0.0), TUNNEL_M))
    pieces[::niche_every] = along(road_line, (_tube(half, height, NICHE_M), niche_every * TUNNEL_M))
    lamp = (block(OTHER_OBJECT, 1.2, 0.4, 0.25, y=rng.choice((0.0, half - 1)), bottom=height - 0.3),)
    return Site(path, [*pieces, *along(road_line, (lamp, rng.uniform(8, 14)))], painted_ground(ROAD))


def _tube(half: float, height: float, niche: float) -> ObjectModel:
    """Walls and ceiling of a piece of tunnel. The right wall is `niche` metres farther out than `half`."""
    length, offset = OVERLAP * TUNNEL_M, half + THICK_M / 2
    wall = block(BUILDING, length, THICK_M, height + 0.5, y=offset, roughness=0.02)
    ceiling = block(BUILDING, length, 2 * half + 1, 0.5, bottom=height, roughness=0.02)
    return wall, wall._replace(y=-offset - niche), ceiling


def bridge(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Bridge with railings, lamps and pylons, half of the time with hangers. Beside its deck, rays do not return."""
    road_line, path = road(rng, length_m, closed)
    half, rail_height, hangers_m, lamps_m, pylons_m = rng.uniform((5, 0.9, 8, 25, 120), (8, 1.3, 15, 45, 260)).tolist()
    bars = [block(FENCE, OVERLAP * 2.0, 0.06, 0.08, y=half, bottom=z * rail_height) for z in (0.5, 0.95)]
    kerb = block(FENCE, OVERLAP * 2.0, 0.3, 0.25, y=half)
    things = [(mirrored(*bars, kerb, post(FENCE, 0.1, rail_height, y=half)), 2.0)]  # pairs of object and spacing
    if rng.random() < 0.5:
        things.append((mirrored(post(POLE, 0.16, 14.0, y=half + 0.6)), hangers_m))
    lamp = post(POLE, 0.2, 8.0, y=half + 0.3)
    things.append((mirrored(lamp) if rng.random() < 0.5 else (lamp,), lamps_m))
    legs = mirrored(block(BUILDING, 2.5, 2.0, 30.0, y=half + 1.8))
    things.append(((*legs, block(BUILDING, 1.5, 2 * half + 2, 2.0, bottom=6.5)), pylons_m))
    lines = [PaintedStrip(road_line, 0.0, 0.2, LANE_MARKING, dash_m=4.0)]
    lines += [PaintedStrip(road_line, y, y + 0.2, LANE_MARKING) for y in (-3.6, 3.4)]
    deck = PaintedStrip(road_line, -half - 0.3, half + 0.3, ROAD)
    return Site(path, along(road_line, *things), painted_ground(NO_RETURN, [deck, *lines]))


def highway(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Four lanes between rails with posts, walls of equal panels, lamps and gantries. Slopes are at most 1.5 %."""
    road_line, path = road(rng, length_m, closed)
    rail_y, wall_y, panel_m = rng.uniform(8, 9.5), rng.uniform(11, 17), rng.uniform(4, 5)
    panel = block(FENCE, OVERLAP * panel_m, 0.2, rng.uniform(2.5, 5), y=wall_y)
    walls = mirrored(panel, post(FENCE, 0.35, 5.2, y=wall_y - 0.1))
    beam = block(FENCE, OVERLAP * 4.0, 0.1, 0.32, y=rail_y, bottom=0.5)
    rails = mirrored(beam, post(POLE, 0.12, 0.8, y=rail_y + 0.12))
    lamps = mirrored(post(POLE, 0.2, 9.0, y=rail_y + 1))
    sign = block(TRAFFIC_SIGN, 0.4, 2 * rail_y + 2, 1.5, bottom=5.5)
    gantry = (*mirrored(post(POLE, 0.4, 6.5, y=rail_y + 0.8)), sign)
    lamps_m, gantries_m = rng.uniform(30, 60), rng.uniform(120, 250)
    spots = along(road_line, (walls, panel_m), (rails, 4.0), (lamps, lamps_m), (gantry, gantries_m))
    lines = [PaintedStrip(road_line, y, y + 0.2, LANE_MARKING, dash_m=4.0) for y in (-LANE_M, 0.0, LANE_M)]
    edges = [PaintedStrip(road_line, y, y + 0.2, LANE_MARKING) for y in (-2 * LANE_M, 2 * LANE_M)]
    ground = painted_ground(TERRAIN, [PaintedStrip(road_line, -rail_y, rail_y, ROAD), *lines, *edges], rolling(rng))
    return Site(path, [*spots, *_traffic(rng, road_line, 1), *_traffic(rng, road_line, -1)], ground)


def _traffic(rng: np.random.Generator, line: Line, direction: int) -> list[Spot]:
    """Vehicles on the outer lane of one direction, one every few seconds. `direction` is 1 along the line, or -1."""
    lane = shifted(line, -1.5 * LANE_M)[:-1] if direction > 0 else shifted(line, 1.5 * LANE_M)[::-1][:-1]
    length_m = len(lane) * STEP_M
    spots, start_s = [], -length_m / 18  # the slowest vehicle of these is at the end of the line when the drive starts
    while start_s < length_m / 6:  # the sensor drives at 12 m/s or faster, at most to the end and back
        thing = moving((car, car, van, truck)[rng.integers(4)](rng))
        speed = rng.uniform(20, 32) if direction > 0 else rng.uniform(18, 28)
        spots += _drive(thing, lane, start_s, speed)
        start_s += rng.uniform(3, 14)
    return spots


def _drive(thing: ObjectModel, lane: Line, start_s: float, speed: float) -> list[Spot]:
    """Drive of `thing` along the whole lane, as pieces of straight motion of 1.5 s."""
    times = np.arange(start_s, start_s + len(lane) * STEP_M / speed, 1.5)
    xy = lane[((times - start_s) * speed / STEP_M).astype(int).clip(0, len(lane) - 1)]
    headings = np.arctan2(*np.diff(xy, axis=0).T[::-1])
    return moving_spots(thing, xy[:-1], xy[1:], headings, times[:-1], times[1:])
