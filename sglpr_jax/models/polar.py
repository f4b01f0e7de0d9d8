"""Resampling between the Cartesian image and a polar one, in which a rotation about the sensor is a shift.

The polar image has `rings` rows, the innermost first, and `sectors` columns, counter-clockwise from x. It covers the
largest circle in the grid. Both directions are bilinear with fixed weights, so they cost a gather.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sglpr_jax.bev import Grid


def to_polar(
    image: Float[Array, "b h w c"], grid: Grid, rings: int, sectors: int
) -> Float[Array, "b {rings} {sectors} c"]:
    """The image read along rings and sectors."""
    radius_cells = min(grid.height, grid.width) / 2
    radius = (np.arange(rings) + 0.5) * (radius_cells / rings)
    angle = (np.arange(sectors) + 0.5) * (2 * np.pi / sectors)
    row = (grid.height - 1) / 2 - np.outer(radius, np.sin(angle))
    column = (grid.width - 1) / 2 + np.outer(radius, np.cos(angle))
    return _sample(image, row.clip(0, grid.height - 1), column.clip(0, grid.width - 1))


def from_polar(polar: Float[Array, "b r s c"], grid: Grid) -> Float[Array, "b {grid.height} {grid.width} c"]:
    """The polar image read at every cell of the grid; cells beyond the circle get its outermost ring."""
    rings, sectors = polar.shape[1:3]
    down, right = np.mgrid[: grid.height, : grid.width]
    up, right = (grid.height - 1) / 2 - down, right - (grid.width - 1) / 2
    ring = np.hypot(up, right) * (rings / (min(grid.height, grid.width) / 2)) - 0.5
    sector = np.arctan2(up, right) % (2 * np.pi) * (sectors / (2 * np.pi)) - 0.5
    around = jnp.concatenate([polar[:, :, -1:], polar, polar[:, :, :1]], axis=2)
    return _sample(around, ring.clip(0, rings - 1), sector + 1)


def _sample(image: Float[Array, "b h w c"], row: np.ndarray, column: np.ndarray) -> Float[Array, "b _ _ c"]:
    """Bilinear values at fixed places, given as two arrays of one shape."""
    height, width = image.shape[1:3]
    flat = image.reshape(len(image), -1, image.shape[-1])
    top, left = (np.minimum(np.floor(x), size - 2).astype(np.int32) for x, size in ((row, height), (column, width)))
    down, right = row - top, column - left

    def corner(dy: int, dx: int) -> Array:
        weight = (down if dy else 1 - down) * (right if dx else 1 - right)
        index = (top + dy) * width + left + dx
        return flat[:, index.reshape(-1)] * weight.astype(np.float32).reshape(1, -1, 1)

    summed = sum(corner(dy, dx) for dy in (0, 1) for dx in (0, 1))
    return jnp.reshape(summed, (len(image), *row.shape, -1))
