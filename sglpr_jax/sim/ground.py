"""Ground: smooth hills and a raster of semantic labels."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.sim.raw_ids import LANE_MARKING, OTHER_GROUND, PARKING, ROAD
from sglpr_jax.sim.scenery import TOWN, Scenery

CELL_M = 0.25
"""Size of a cell of the raster, in metres."""
KERB_M = 0.12
"""Height of sidewalks, gardens and fields above the road, in metres."""
ROAD_LEVEL = (ROAD, PARKING, OTHER_GROUND, LANE_MARKING)
"""Labels of ground at the level of the road."""

_WAVES = 4


class Relief(NamedTuple):
    """Smooth hills. The height of the road level at p is the sum of amplitude * sin(wave . p + phase)."""

    amplitude: np.ndarray  # (k,) metres
    wave: np.ndarray  # (k, 2) radians per metre
    phase: np.ndarray  # (k,) radians


def draw_relief(rng: np.random.Generator, scenery: Scenery = TOWN) -> Relief:
    """Draws hills with a slope of at most `scenery.steepest`. Some drives are nearly flat."""
    number = 2 * np.pi / rng.uniform(*scenery.wavelength_m, _WAVES)
    bearing = rng.uniform(0, 2 * np.pi, _WAVES)
    slopes = (
        rng.uniform(0.2, 1.0) * scenery.steepest * rng.dirichlet(np.ones(_WAVES))
    )  # their sum is the steepest slope
    wave = number[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    return Relief(slopes / number, wave, rng.uniform(0, 2 * np.pi, _WAVES))


def _angle(relief: Relief, xy: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b k"]:
    return xy @ relief.wave.T + relief.phase


def relief_height(relief: Relief, xy: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b"]:
    """Height of the road level at `xy`, in metres."""
    return np.asarray(np.sin(_angle(relief, xy)) @ relief.amplitude)


def relief_gradient(relief: Relief, xy: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 2"]:
    """Slope of the road level at `xy`, along x and y."""
    return (np.cos(_angle(relief, xy)) * relief.amplitude) @ relief.wave


def relief_curvature(relief: Relief, xy: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 2 2"]:
    """Matrix of the second derivatives of the road level at `xy`, in 1 / metres."""
    weight = -np.sin(_angle(relief, xy)) * relief.amplitude
    return np.einsum("...k,ki,kj->...ij", weight, relief.wave, relief.wave)


class Ground(NamedTuple):
    """Raster of the labels of the ground, and the hills below it."""

    label: np.ndarray  # (rows, columns) uint8 raw SemanticKITTI ids; row = y, column = x, cells of CELL_M
    origin: np.ndarray  # (2,) x and y of the raster's first corner, metres
    relief: Relief

    def around(self, centre: Float[np.ndarray, "2"], reach_m: float) -> "Ground":
        """Crops a square of half size `reach_m` around `centre`. Outside the raster, the labels of its edge repeat."""
        cells = int(reach_m / CELL_M) + 1
        first = np.floor((centre - self.origin) / CELL_M).astype(int) - cells
        columns, rows = (first[:, None] + np.arange(2 * cells + 1)).clip(0, np.array(self.label.shape)[::-1, None] - 1)
        return Ground(self.label[np.ix_(rows, columns)], self.origin + first * CELL_M, self.relief)


def label_at(ground: Ground, xy: Float[np.ndarray, "*b 2"]) -> Int[np.ndarray, "*b"]:
    """Label of the cell at each point. Outside the raster, the labels of its edge repeat."""
    cell = np.floor((xy - ground.origin) / CELL_M).astype(int)
    column, row = (cell[..., axis].clip(0, ground.label.shape[1 - axis] - 1) for axis in (0, 1))
    return np.asarray(ground.label[row, column], dtype=np.int32)


def is_raised(label: Int[np.ndarray, "*b"]) -> Bool[np.ndarray, "*b"]:
    """Whether ground with this label is KERB_M above the road."""
    return np.asarray(~np.isin(label, ROAD_LEVEL))


def surface_height(ground: Ground, xy: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b"]:
    """Height of the ground at `xy` including kerbs, in metres."""
    return np.asarray(relief_height(ground.relief, xy) + KERB_M * is_raised(label_at(ground, xy)))
