"""Forest: trunks at random positions along a winding path, with undergrowth, on slopes."""

import dataclasses

import numpy as np
from jaxtyping import Float

from sglpr_jax.sim import plants
from sglpr_jax.sim.ground import draw_relief
from sglpr_jax.sim.raw_ids import OTHER_GROUND, TERRAIN, TRUNK, VEGETATION
from sglpr_jax.sim.sceneries.site import Site, Spot, Strip, post, striped_ground
from sglpr_jax.sim.sceneries.ways import STEP_M, Line, rounded
from sglpr_jax.sim.scenery import TOWN
from sglpr_jax.sim.things import Part, Thing

WIDE_M = 38.0
"""Half width of the forest on both sides of the path, in metres."""
BEND_M = 25.0
"""Distance between two bends of the path, in metres."""
_HILLS = dataclasses.replace(TOWN, steepest=0.12, wavelength_m=(40.0, 200.0))


def forest(rng: np.random.Generator, length_m: float, closed: bool) -> Site:
    """Trees of one stand: 250 to 900 trunks a hectare, 0.1 to 0.6 m thick, and a bush for every 3 to 30 trunks."""
    line = _path(rng, length_m, closed)
    density, thick = rng.uniform(0.025, 0.09), rng.uniform(0.15, 0.35)
    branches, shrubs = rng.uniform(3.0, 7.0), 1 / rng.uniform(3, 30)
    trunks = [Spot(_tree(rng, thick, branches), x, y) for x, y in _scattered(rng, line, density)]
    bushes = [
        Spot(plants.bush(rng), x, y, rng.uniform(0, 2 * np.pi)) for x, y in _scattered(rng, line, shrubs * density)
    ]
    ground = striped_ground(TERRAIN, [Strip(line, -0.6, 0.6, OTHER_GROUND)], draw_relief(rng, _HILLS))
    return Site(line, [*trunks, *bushes], ground)


def _path(rng: np.random.Generator, length_m: float, closed: bool) -> Line:
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
    near = np.array([_away(line, point) < WIDE_M for point in points], bool)
    return [(float(x), float(y)) for x, y in points[near]]


def _away(line: Line, point: Float[np.ndarray, " 2"]) -> float:
    """Distance of a point from a line, in metres."""
    return float(np.linalg.norm(line[:: round(1 / STEP_M)] - point, axis=1).min())


def _tree(rng: np.random.Generator, thick: float, branches: float) -> Thing:
    """Trunk, and a crown that begins at about `branches` metres. The thickness has a log-normal distribution."""
    thick = float(thick * np.exp(rng.normal(scale=0.35)))
    wide, bottom = 10 * thick * rng.uniform(0.7, 1.3), branches * rng.uniform(0.7, 1.3)
    size = wide, wide, wide * rng.uniform(1.2, 2.0)
    leaves = Part("ellipsoid", VEGETATION, size, bottom=bottom, roughness=0.8, porosity=0.6)
    return post(TRUNK, thick, bottom + 0.4 * size[2]), leaves
