"""Parallel rows: orchard, vineyard, solar farm, warehouse and container terminal."""

import numpy as np
from jaxtyping import Float

from sglpr_jax.sim.labels import BUILDING, OTHER_GROUND, OTHER_OBJECT, PARKING, POLE, TRUNK, VEGETATION
from sglpr_jax.sim.objects import ObjectModel, ball, block, post
from sglpr_jax.sim.placement import Spot
from sglpr_jax.sim.sceneries.site import Rows, Site, grid, jittered, painted_ground, rolling, rows, track

APART_M = 22.0  # minimum distance between passes in open land, in metres, for which the vehicle skips rows
LANE_M = 9.0  # width of the lanes between blocks of containers, in metres
LEVEL_M = 1.7  # height of a level of the shelves of a warehouse, in metres
FREE_M = 5.0  # free length at both ends of a row in open land, in metres


def _open_land(
    length_m: float, closed: bool, *, pitch_m: float, run_m: float
) -> tuple[Rows, Float[np.ndarray, " rows"]]:
    """Path between rows of about `run_m` metres that are `pitch_m` apart, and y of all rows.

    The path skips rows, so that its passes are at least APART_M apart.
    """
    skip = int(np.ceil(APART_M / pitch_m))
    plan = rows(length_m, run_m=run_m, pitch_m=skip * pitch_m, closed=closed, back_m=6.0, corner_m=2.0)
    return plan, pitch_m * (np.arange(-2 * skip, (plan.count + 1) * skip) + 0.5)


def orchard(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Rows of trees of one kind and age, 5 to 6.5 m apart, with a tree every 3 to 4.5 m."""
    pitch, spacing, crown = rng.uniform(5, 6.5), rng.uniform(3, 4.5), rng.uniform(2.0, 2.7)
    plan, row_ys = _open_land(length_m, closed, pitch_m=pitch, run_m=rng.uniform(70, 110))

    def fruit_tree() -> ObjectModel:
        width, height = crown * rng.uniform(0.9, 1.1), crown * rng.uniform(1.0, 1.3)
        leaves = ball(VEGETATION, width, height, bottom=0.8, roughness=0.5, porosity=0.5)
        return post(TRUNK, rng.uniform(0.12, 0.2), 1.8), leaves

    trees = grid(np.arange(FREE_M, plan.run_m - FREE_M, spacing), row_ys, fruit_tree)
    ground = track(plan.line, 1.5, rolling(rng))
    return Site(plan.line, jittered(rng, trees, 0.12, keep=0.97), ground)


def vineyard(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Rows of vines 2.8 to 3.4 m apart, with a post every 4 to 6 m."""
    pitch, post_spacing, height, thickness = rng.uniform((2.8, 4, 1.6, 0.35), (3.4, 6, 2.2, 0.6)).tolist()
    plan, row_ys = _open_land(length_m, closed, pitch_m=pitch, run_m=rng.uniform(70, 110))

    def vines() -> ObjectModel:  # leaves between two posts, and the first post
        top, width = height * rng.uniform(0.9, 1.05), thickness * rng.uniform(0.8, 1.2)
        size, porosity = (post_spacing, width, top - 0.6), rng.uniform(0.3, 0.6)
        leaves = block(VEGETATION, *size, bottom=0.6, roughness=0.2, porosity=porosity)
        return leaves, post(POLE, 0.1, height + 0.15, -post_spacing / 2)

    middle_xs = np.arange(FREE_M, plan.run_m - FREE_M - post_spacing, post_spacing) + post_spacing / 2
    return Site(plan.line, grid(middle_xs, row_ys, vines), track(plan.line, 1.2, rolling(rng)))


def solar(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Rows of equal panels 7 to 10 m apart. The panels are 8 to 16 m long and tilted by 15 to 30 degrees."""
    pitch, length, depth, tilt, low = rng.uniform((7, 8, 2.2, 15, 0.6), (10, 16, 3.8, 30, 1.0)).tolist()
    plan, row_ys = _open_land(length_m, closed, pitch_m=pitch, run_m=rng.uniform(80, 130))
    # A panel consists of eight level slats, like stairs, because shapes have no tilt.
    width, rise = np.cos(np.radians(tilt)) * depth / 8, np.sin(np.radians(tilt)) * depth / 8
    slat_ys = ((np.arange(8) - 3.5) * width).tolist()
    slats = [block(OTHER_OBJECT, length, width, rise + 0.02, y=y, bottom=low + k * rise) for k, y in enumerate(slat_ys)]
    post_xs = np.linspace(-length / 2 + 1, length / 2 - 1, 4).tolist()
    panel = *slats, *(post(POLE, 0.12, low + k * rise, x, slat_ys[k]) for k in (1, 6) for x in post_xs)
    panels = grid(np.arange(FREE_M + length / 2, plan.run_m - FREE_M - length / 2, length + 0.4), row_ys, lambda: panel)
    return Site(plan.line, panels, track(plan.line, 1.5, rolling(rng)))


def warehouse(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Aisles 5 to 6 m apart, between shelves with three levels that are 85 to 95 % full."""
    pitch, aisle, bay, occupancy = rng.uniform((5, 2.6, 2.4, 0.85), (6, 3.0, 3.0, 0.95)).tolist()
    plan = rows(length_m, run_m=rng.uniform(25, 40), pitch_m=pitch, closed=closed, back_m=2.5, corner_m=0.6)
    shelf_ys = pitch * np.arange(-1, plan.count + 2) - pitch / 2
    bay_xs = np.arange(2.5, plan.run_m - 2.5 - bay, bay) + bay / 2
    spots = grid(bay_xs, shelf_ys, lambda: _shelf(rng, bay, pitch - aisle, occupancy))
    height = rng.uniform(6, 9)
    x, y = plan.run_m / 2, (shelf_ys[0] + shelf_ys[-1]) / 2
    length, width = plan.run_m + 14.0, shelf_ys[-1] - shelf_ys[0] + 6.0
    walls = [block(BUILDING, length, 0.4, height, y=side * width / 2) for side in (-1, 1)]
    walls += [block(BUILDING, 0.4, width, height, x=side * length / 2) for side in (-1, 1)]
    ceiling = block(BUILDING, length, width, 0.4, bottom=height)
    return Site(plan.line, [*spots, Spot((*walls, ceiling), x, y)], painted_ground(OTHER_GROUND))


def _shelf(rng: np.random.Generator, bay: float, depth: float, occupancy: float) -> ObjectModel:
    """One bay of a double shelf: a frame, two boards, and pallets on three levels on both sides."""
    parts = [block(POLE, 0.12, 0.12, 3.4 * LEVEL_M, -bay / 2, side * (depth / 2 - 0.06)) for side in (-1, 1)]
    parts += [block(OTHER_OBJECT, bay, depth, 0.14, bottom=level * LEVEL_M) for level in (1, 2)]
    for level in range(3):
        for side in (-1, 1):
            low, high = (0.75 * bay, 0.38 * depth, 0.8), (0.92 * bay, 0.46 * depth, 1.45)
            width, thickness, height = rng.uniform(low, high).tolist()
            if rng.random() < occupancy:
                y = side * (depth / 2 - thickness / 2 - rng.uniform(0, 0.1))
                parts.append(block(OTHER_OBJECT, width, thickness, height, y=y, bottom=level * LEVEL_M + 0.14))
    return tuple(parts)


def terminal(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Blocks five or six containers wide, with stacks of one to five containers, between lanes along x and along y."""
    block_columns, length, run = int(rng.integers(5, 7)), float(rng.choice((6.06, 12.19))), rng.uniform(95, 125)
    width, height, gap = 2.44, 2.59, 0.35  # of a container, and between containers, in metres
    pitch, bay = block_columns * (width + gap) + LANE_M, length + gap
    plan = rows(length_m, run_m=run, pitch_m=pitch, closed=closed, back_m=LANE_M / 2, corner_m=2.5)
    lane_ys = pitch * np.arange(-2, plan.count + 1)
    lane_xs, block_pitch = np.linspace(0, plan.run_m, 1 + max(1, round(plan.run_m / 55.0)), retstep=True)
    bay_middles = (np.arange((block_pitch - LANE_M) // bay) + 0.5) * bay
    xs = (lane_xs[:-1, None] + LANE_M / 2 + bay_middles).ravel()
    ys = (lane_ys[:, None] + LANE_M / 2 + (np.arange(block_columns) + 0.5) * (width + gap)).ravel()
    stacks = grid(xs, ys, lambda: (block(OTHER_OBJECT, length, width, height * int(rng.integers(1, 6))),))
    masts = grid(lane_xs[:-1] + LANE_M / 2 - 1.0, lane_ys + LANE_M / 2 + 0.5, lambda: (post(POLE, 0.5, 20.0),))
    return Site(plan.line, [*jittered(rng, stacks, 0.04), *masts], painted_ground(PARKING))
