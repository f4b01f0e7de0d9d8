"""Places to park: an open car park, a garage with floors side by side, and one with storeys above one another."""

import numpy as np
from jaxtyping import Float

from sglpr_jax.sim.labels import BUILDING, PARKING, POLE
from sglpr_jax.sim.objects import ObjectModel, block, car, parked, post
from sglpr_jax.sim.placement import Spot
from sglpr_jax.sim.sceneries.site import (
    Site,
    closed_box,
    grid,
    jittered,
    on_both_sides,
    painted_ground,
    rounded,
    rows,
    wall,
)
from sglpr_jax.sim.world import Levels

CAR_M, PILLAR_M, HALF_M = 5.8, 4.2, 8.8
"""Distance from the middle of an aisle to the cars, to the pillars, and to the wall behind the cars, in metres."""
TURN_M = 5.0  # space for turning at the ends of aisles and ramps, in metres
PITCH_M = 11.5  # distance between the aisle of a floor and the next ramp, in metres
WIDE_M, RAMP_M = 17.5, 12.0  # distance between a storey's aisles, and from the upper one to the ramp, in metres


def car_park(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Equal aisles, 22 to 28 m apart, with parked cars on both sides and lamps between the aisles."""
    pitch, stall, occupancy = rng.uniform(22, 28), rng.uniform(2.5, 2.8), rng.uniform(0.8, 0.92)
    plan = rows(length_m, run_m=rng.uniform(60, 100), pitch_m=pitch, closed=closed, back_m=7.0, corner_m=2.5)
    aisle_ys = pitch * np.arange(-2, plan.count + 2)  # two more than driven on each side
    stall_xs, stall_offset = np.arange(6.0, plan.run_m - 6.0, stall), rng.uniform(5.8, 6.5)
    cars = on_both_sides(stall_xs, aisle_ys, stall_offset, lambda: parked(rng), np.pi / 2)
    lamp_xs = np.arange(6.0, plan.run_m, rng.uniform(20, 30))
    lamps = grid(lamp_xs, aisle_ys + pitch / 2, lambda: (post(POLE, 0.25, 7.0),))
    return Site(plan.line, [*jittered(rng, cars, 0.15, keep=occupancy), *lamps], painted_ground(PARKING))


def garage(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Floors side by side, hidden from each other by walls. Rows 0, 2, 4, ... are floors, the others ramps."""
    run, height, occupancy = rng.uniform(30, 40), rng.uniform(2.4, 3.0), rng.uniform(0.75, 0.92)
    plan = rows(length_m, run_m=run, pitch_m=PITCH_M, closed=closed, back_m=9.0, corner_m=1.5)
    aisle_ys = PITCH_M * np.arange(0, plan.count, 2)
    spots = _floor(rng, plan.run_m, aisle_ys, stall=rng.uniform(2.5, 2.7), height=height, occupancy=occupancy)
    spots.append(Spot(_shell(plan.count, plan.run_m, height, closed), 0.0, 0.0))
    return Site(plan.line, spots, painted_ground(PARKING))


def _floor(
    rng: np.random.Generator,
    run_m: float,
    aisle_ys: Float[np.ndarray, " _"],
    *,
    stall: float,
    height: float,
    occupancy: float,
) -> list[Spot]:
    """Cars in stalls of width `stall`, and pillars, along aisles along x. A fraction `occupancy` of stalls is full."""
    xs, pillar = np.arange(TURN_M, run_m - TURN_M, stall), (block(BUILDING, 0.4, 0.6, height),)
    cars = jittered(rng, on_both_sides(xs, aisle_ys, CAR_M, lambda: car(rng), np.pi / 2), 0.12, keep=occupancy)
    pillar_ys = np.concatenate([aisle_ys - PILLAR_M, aisle_ys + PILLAR_M])
    return cars + grid(xs[::3] - stall / 2, pillar_ys, lambda: pillar)


def _shell(count: int, run_m: float, height: float, closed: bool) -> ObjectModel:
    """Ceiling, outer walls, and a wall between neighbouring rows. The wall is open at the end where the path passes."""
    min_x, max_x = -TURN_M, run_m + TURN_M
    walls = []
    for k in range(count - 1):  # the wall after row k is HALF_M from the middle of a floor; even rows are floors
        if k % 2 == 0:
            y, first_x, last_x = k * PITCH_M + HALF_M, min_x, run_m - TURN_M
        else:
            y, first_x, last_x = (k + 1) * PITCH_M - HALF_M, TURN_M, max_x
        walls.append(wall((first_x, y), (last_x, y), height))
    if closed:  # a ramp from the last row to the first
        walls.append(wall((min_x, 4.0), (min_x, (count - 1) * PITCH_M - 4.0), height))
        min_x -= 8.0
    return *walls, *closed_box(min_x, max_x, -HALF_M, (count - 1) * PITCH_M + HALF_M, height)


def storeys(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Three to six storeys with the same walls and pillars, and with different cars, joined by ramps.

    The path laps each storey once on its way up, a closed one the lowest twice, for up to twice `length_m`.
    """
    run, rise, stall, occupancy = rng.uniform((34, 3.0, 2.5, 0.7), (44, 3.6, 2.7, 0.9)).tolist()
    lap_m = 2 * (run + WIDE_M + RAMP_M)
    fewest, most = (int(np.clip(np.ceil(metres / lap_m), 3, 6)) for metres in (length_m, 2 * length_m))
    count, height = int(rng.integers(fewest, most + 1)), rise - 0.3
    ramp_y = WIDE_M + HALF_M
    ramp_wall = wall((TURN_M, ramp_y), (run - TURN_M, ramp_y), height)  # between storey and ramp, open at both ends
    *outer_walls, ceiling = closed_box(-TURN_M, run + TURN_M, -HALF_M, WIDE_M + RAMP_M + 3.0, height)
    shell = *outer_walls, ramp_wall, ceiling
    spots, pitch = [], 45.0
    for y in pitch * np.arange(count):
        spots += _floor(rng, run, np.array([y, y + WIDE_M]), stall=stall, height=height, occupancy=occupancy)
        spots.append(Spot(shell, 0.0, float(y)))
    lap = [(0.0, WIDE_M), (0.0, 0.0), (run, 0.0), (run, WIDE_M)]
    ramp = [(run, WIDE_M + RAMP_M), (0.0, WIDE_M + RAMP_M)]
    corners = (lap + ramp) * (count - 1) + lap  # no ramp from the highest storey
    if closed:
        corners = lap + corners
    line = rounded(corners, corner_m=1.5)
    levels = Levels(rise_m=rise, pitch_m=pitch, ramp_y_m=ramp_y, top_m=TURN_M, foot_m=run - TURN_M)
    return Site(line, spots, painted_ground(PARKING), levels, returns=closed)
