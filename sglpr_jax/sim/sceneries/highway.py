"""Highway between guard rails and noise walls, with posts and gantries at equal distances, and traffic."""

import numpy as np

from sglpr_jax.sim import vehicles
from sglpr_jax.sim.raw_ids import FENCE, LANE_MARKING, POLE, ROAD, TERRAIN, TRAFFIC_SIGN
from sglpr_jax.sim.sceneries.site import OVERLAP, Site, Spot, Strip, along, block, post, rolling, striped_ground
from sglpr_jax.sim.sceneries.ways import STEP_M, Line, road, shifted
from sglpr_jax.sim.things import Thing

LANE_M = 3.5
"""Width of each of the four lanes, in metres. The vehicle uses the inner lanes, other traffic the outer lanes."""
PIECE_S = 1.5
"""Duration of a straight piece of a vehicle's motion, in seconds."""


def highway(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Four lanes between rails with posts, walls of equal panels, lamps and gantries. Slopes are at most 1.5 %."""
    whole, driven = road(rng, length_m, closed)
    rail, wall, panel = rng.uniform(8, 9.5), rng.uniform(11, 17), rng.uniform(4, 5)
    fence = _both(block(FENCE, OVERLAP * panel, 0.2, rng.uniform(2.5, 5), y=wall), post(FENCE, 0.35, 5.2, y=wall - 0.1))
    beam = block(FENCE, OVERLAP * 4.0, 0.1, 0.32, y=rail, bottom=0.5)
    rails = _both(beam, post(POLE, 0.12, 0.8, y=rail + 0.12))
    lamps = _both(post(POLE, 0.2, 9.0, y=rail + 1))
    gantry = (*_both(post(POLE, 0.4, 6.5, y=rail + 0.8)), block(TRAFFIC_SIGN, 0.4, 2 * rail + 2, 1.5, bottom=5.5))
    things = ((fence, panel), (rails, 4.0), (lamps, rng.uniform(30, 60)), (gantry, rng.uniform(120, 250)))
    spots = [spot for thing, every in things for spot in along(whole, lambda thing=thing: thing, every)]
    lines = [Strip(whole, y, y + 0.2, LANE_MARKING, 4.0) for y in (-LANE_M, 0.0, LANE_M)]
    edges = [Strip(whole, y, y + 0.2, LANE_MARKING) for y in (-2 * LANE_M, 2 * LANE_M)]
    ground = striped_ground(TERRAIN, [Strip(whole, -rail, rail, ROAD), *lines, *edges], rolling(rng))
    return Site(driven, [*spots, *_traffic(rng, whole, 1), *_traffic(rng, whole, -1)], ground)


def _both(*parts) -> Thing:
    """Parts and their mirror images."""
    return *parts, *(part._replace(y=-part.y) for part in parts)


def _traffic(rng: np.random.Generator, line: Line, direction: int) -> list[Spot]:
    """Vehicles on the outer lane of one direction, one every few seconds."""
    lane = shifted(line, -1.5 * LANE_M)[:-1] if direction > 0 else shifted(line, 1.5 * LANE_M)[::-1][:-1]
    length = len(lane) * STEP_M
    spots, start = [], -length / 18
    while start < length / 6:  # the vehicle is faster than 12 m/s, and may return
        thing = vehicles.moving((vehicles.car, vehicles.car, vehicles.van, vehicles.truck)[rng.integers(4)](rng))
        spots += _drive(thing, lane, start, rng.uniform(20, 32) if direction > 0 else rng.uniform(18, 28))
        start += rng.uniform(3, 14)
    return spots


def _drive(thing: Thing, lane: Line, start: float, speed: float) -> list[Spot]:
    """Drive along the whole lane, as pieces of straight motion."""
    times = np.arange(start, start + len(lane) * STEP_M / speed, PIECE_S)
    at = ((times - start) * speed / STEP_M).astype(int).clip(0, len(lane) - 1)
    spots = []
    for k in range(len(times) - 1):
        velocity = (lane[at[k + 1]] - lane[at[k]]) / PIECE_S
        x, y = (lane[at[k]] - velocity * times[k]).tolist()
        heading = float(np.arctan2(velocity[1], velocity[0]))
        spots.append(Spot(thing, x, y, heading, 1, tuple(velocity.tolist()), times[k], times[k + 1]))
    return spots
