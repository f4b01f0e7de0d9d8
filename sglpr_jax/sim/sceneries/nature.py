"""Open land and woods: a field with few objects, and a forest."""

from collections.abc import Callable, Iterator

import numpy as np

from sglpr_jax.sim.drive import shifted
from sglpr_jax.sim.ground import draw_relief
from sglpr_jax.sim.labels import POLE, TRUNK, VEGETATION
from sglpr_jax.sim.objects import ObjectModel, Range, ball, bush, garage, post, tree
from sglpr_jax.sim.placement import Spot
from sglpr_jax.sim.routes import Line
from sglpr_jax.sim.sceneries.site import STEP_M, Site, along, road, rolling, rounded, track

WIDE_M = 38.0  # half width of the forest on both sides of the path, in metres
BEND_M = 25.0  # distance between two bends of the path through the forest, in metres


def field(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Track through fields, with posts or poles along it, some bushes, and distant single trees and sheds."""
    road_line, path = road(rng, length_m, closed)
    spacing, thickness, height = (4.0, 0.12, 1.2) if rng.integers(2) == 0 else (35.0, 0.3, 8.0)
    offset = rng.choice((-1, 1)) * 5.0
    posts = along(shifted(road_line, offset), ((post(POLE, thickness, height),), spacing))
    bushes = _beside(rng, road_line, rng.uniform(20, 50), (6.0, 25.0), lambda: bush(rng))

    def tree_or_shed() -> ObjectModel:
        return garage(rng, rng.uniform(5, 12)) if rng.random() < 0.25 else tree(rng, (3.0, 7.0))

    distant = _beside(rng, road_line, rng.uniform(30, 80), (30.0, 75.0), tree_or_shed)
    ground = track(road_line, 1.5, rolling(rng))
    return Site(path, [*posts, *bushes, *distant], ground)


def _beside(
    rng: np.random.Generator, line: Line, every_m: float, distance_m: Range, make: Callable[[], ObjectModel]
) -> Iterator[Spot]:
    """Yields objects at random positions beside a line, on average one per `every_m` metres of the line."""
    for _ in range(round(len(line) * STEP_M / every_m)):
        offset = np.array([rng.uniform(*distance_m) * rng.choice((-1, 1))])
        row = int(rng.integers(1, len(line) - 1))
        x, y = shifted(line[row - 1 : row + 2], offset)[1].tolist()  # `shifted` needs the neighbours
        yield Spot(make(), x, y, rng.uniform(0, 2 * np.pi))


def forest(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Trees of similar size on slopes, 250 to 900 a hectare, with a bush for every 3 to 30 trunks."""
    line = _winding_path(rng, length_m, closed)
    density, thickness = rng.uniform(0.025, 0.09), rng.uniform(0.15, 0.35)
    crown_bottom, bushes_per_tree = rng.uniform(3.0, 7.0), 1 / rng.uniform(3, 30)
    spots = [Spot(_tree(rng, thickness, crown_bottom), x, y) for x, y in _scattered(rng, line, density)]
    for x, y in _scattered(rng, line, bushes_per_tree * density):
        spots.append(Spot(bush(rng), x, y, rng.uniform(0, 2 * np.pi)))
    relief = draw_relief(rng, steepest=0.12, wavelength_m=(40.0, 200.0))
    return Site(line, spots, track(line, 0.6, relief))


def _winding_path(rng: np.random.Generator, length_m: float, closed: bool) -> Line:
    """Path with a bend of up to 50 degrees every 25 m, or a closed one that winds around a circle."""
    if closed:
        angles = np.linspace(0, 2 * np.pi, max(round(length_m / BEND_M), 6), endpoint=False)
        radius = length_m / (2 * np.pi) * rng.uniform(0.75, 1.25, len(angles))
        corners = radius[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    else:
        bends = rng.uniform(-50, 50, round(length_m / BEND_M) + 1)
        heading = np.radians(np.cumsum(bends - bends.mean()))
        corners = BEND_M * np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    return rounded(corners, corner_m=4.0, closed=closed)


def _scattered(rng: np.random.Generator, line: Line, density: float) -> list[tuple[float, float]]:
    """Random positions within `WIDE_M` of a line, `density` per square metre."""
    low, high = line.min(axis=0) - WIDE_M, line.max(axis=0) + WIDE_M
    points = rng.uniform(low, high, (round(density * np.prod(high - low)), 2))
    coarse_line = line[:: round(1 / STEP_M)]  # one point per metre
    is_near = [np.linalg.norm(coarse_line - point, axis=1).min() < WIDE_M for point in points]
    return [(float(x), float(y)) for x, y in points[is_near]]


def _tree(rng: np.random.Generator, median_thickness: float, crown_bottom: float) -> ObjectModel:
    """Tree with a log-normal thickness. Its crown begins at about `crown_bottom` metres above the ground."""
    thickness = float(median_thickness * np.exp(rng.normal(scale=0.35)))
    width, bottom = 10 * thickness * rng.uniform(0.7, 1.3), crown_bottom * rng.uniform(0.7, 1.3)
    height = width * rng.uniform(1.2, 2.0)
    crown = ball(VEGETATION, width, height, bottom=bottom, roughness=0.8, porosity=0.6)
    return post(TRUNK, thickness, bottom + 0.4 * height), crown
