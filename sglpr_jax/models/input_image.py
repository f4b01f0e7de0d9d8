"""Conversion of an image of counts to network input: scaling, field of view and, if configured, polar resampling.

A polar image has `radii` rows, the innermost first, and `sectors` columns, counter-clockwise from the x axis. It covers
the largest circle in the grid. A rotation about the sensor shifts its columns. The resampling is bilinear.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

from sglpr_jax.grid import DENSITY_MAX_COUNT, Grid
from sglpr_jax.models.config import ModelConfig

CLIP_COUNT = 10.0
"""Maximum of clipped point counts (`ModelConfig.counts`)."""
FEWEST_CELLS = 2
"""Minimum number of cells with points in an image that shows a place. All empty images have the same descriptor."""


def prepare(bev: Num[Array, "b h w"], config: ModelConfig) -> Float[Array, "b h w {config.channels}"]:
    """Convert point counts to network input, scaled as in `config.counts` and 0 outside the field of view.

    Density images have counts as floats, or grey values as uint8. Raises ValueError if they have another integer type.
    """
    counts = jnp.asarray(bev, jnp.float32)
    if config.image == "density" and not jnp.issubdtype(bev.dtype, jnp.floating):
        if bev.dtype != jnp.uint8:
            raise ValueError(
                "this model describes density images: expected counts 0 to 10 as floats, or grey values 0 to 255 as "
                f"uint8, found {bev.dtype}, which has lost the fractions of the counts"
            )
        counts = counts * np.float32(DENSITY_MAX_COUNT / 255)
    if config.counts == "log1p":
        counts = jnp.log1p(counts)
    elif config.counts == "clipped":
        counts = jnp.minimum(counts, CLIP_COUNT) / CLIP_COUNT
    image = jnp.where(field_of_view(config), counts, 0.0)[..., None]
    if config.range_channel:
        distance = cell_distance(config.grid) / cell_distance(config.grid).max()
        image = jnp.concatenate([image, jnp.broadcast_to(distance[None, ..., None], image.shape)], axis=-1)
    return image


def backbone_view(image: Float[Array, "b h w c"], config: ModelConfig) -> Float[Array, "b p q c"]:
    """Convert an image to the input of the backbone: polar with `config.polar`, of the data type `config.compute`."""
    polar = to_polar(image, config.grid, *config.polar) if config.polar else image
    return polar.astype(config.compute)


def field_of_view(config: ModelConfig) -> Bool[np.ndarray, "1 h w"]:
    """Return True for cells that the network sees: inside `config.field` and at least `blind_m` from the sensor."""
    grid, distance = config.grid, cell_distance(config.grid)
    visible = distance >= config.blind_m
    if config.field == "circle":
        visible &= distance < grid.resolution_m * min(grid.height, grid.width) / 2
    return visible[None]


def cell_distance(grid: Grid) -> Float[np.ndarray, "h w"]:
    """Return the distance of each cell's centre from the sensor, in metres."""
    row, column = np.mgrid[: grid.height, : grid.width]
    distance_cells = np.hypot(row - (grid.height - 1) / 2, column - (grid.width - 1) / 2)
    return (grid.resolution_m * distance_cells).astype(np.float32)


class Taps(NamedTuple):
    """Table for a resampling: each of n output pixels is a weighted sum of k pixels of the flattened input image."""

    pixel: np.ndarray  # indices of the input pixels, (k, n) int32
    weight: np.ndarray  # their weights, (k, n) float32


def to_polar(
    image: Float[Array, "b h w c"], grid: Grid, radii: int, sectors: int
) -> Float[Array, "b {radii} {sectors} c"]:
    """Sample the image at `radii` distances from its middle and in `sectors` directions."""
    radius_cells = min(grid.height, grid.width) / 2
    radius = (np.arange(radii) + 0.5) * (radius_cells / radii)
    angle = (np.arange(sectors) + 0.5) * (2 * np.pi / sectors)
    row = (grid.height - 1) / 2 - np.outer(radius, np.sin(angle))
    column = (grid.width - 1) / 2 + np.outer(radius, np.cos(angle))
    taps = _bilinear_taps(row.clip(0, grid.height - 1), column.clip(0, grid.width - 1), grid.height, grid.width)
    return resample(_flat(image), taps).reshape(image.shape[0], radii, sectors, -1)


def from_polar(polar: Float[Array, "b r s c"], grid: Grid) -> Float[Array, "b {grid.height} {grid.width} c"]:
    """Sample the polar image at every cell of the grid. Cells outside the circle are zero.

    The function is differentiable in reverse mode only. Its gradient reads a table, too, because the scatter of JAX's
    own gradient is six times slower on a CPU.
    """
    radii, sectors = polar.shape[1:3]
    row, column = np.mgrid[: grid.height, : grid.width]
    x, y = column - (grid.width - 1) / 2, (grid.height - 1) / 2 - row
    circle_cells = min(grid.height, grid.width) / 2
    polar_row = np.hypot(y, x) * (radii / circle_cells) - 0.5
    polar_column = np.arctan2(y, x) % (2 * np.pi) * (sectors / (2 * np.pi)) - 0.5
    taps = _bilinear_taps(polar_row.clip(0, radii - 1), polar_column, radii, sectors)
    is_in_circle = (np.hypot(y, x) < circle_cells).reshape(-1)
    taps = Taps(taps.pixel, taps.weight * is_in_circle)
    gradient_taps = _transposed_taps(taps, radii * sectors)
    sample = jax.custom_vjp(lambda flat: resample(flat, taps))
    sample.defvjp(lambda flat: (resample(flat, taps), None), lambda _, gradient: (resample(gradient, gradient_taps),))
    return sample(_flat(polar)).reshape(polar.shape[0], grid.height, grid.width, -1)


def _flat(image: Float[Array, "b h w c"]) -> Float[Array, "b h*w c"]:
    return image.reshape(image.shape[0], -1, image.shape[-1])


def _bilinear_taps(row: np.ndarray, column: np.ndarray, height: int, width: int) -> Taps:
    """Return the four pixels around each position (row, column). Rows must lie in the image; columns wrap around."""
    top, left = np.minimum(np.floor(row), height - 2).astype(np.int32), np.floor(column).astype(np.int32)
    row_weights = (1 - (row - top), row - top)
    column_weights = (1 - (column - left), column - left)
    corners = [(dy, dx) for dy in (0, 1) for dx in (0, 1)]
    pixel = [(top + dy) * width + (left + dx) % width for dy, dx in corners]
    weight = [row_weights[dy] * column_weights[dx] for dy, dx in corners]
    return Taps(np.reshape(pixel, (4, -1)).astype(np.int32), np.reshape(weight, (4, -1)).astype(np.float32))


def _transposed_taps(taps: Taps, pixels: int) -> Taps:
    """Return, for each of the input pixels, the output pixels that read it and their weights, padded by weight 0."""
    is_used = taps.weight > 0
    output = np.broadcast_to(np.arange(taps.pixel.shape[1]), taps.pixel.shape)[is_used]
    pixel, weight = taps.pixel[is_used], taps.weight[is_used]
    order = np.argsort(pixel, kind="stable")
    pixel, output, weight = pixel[order], output[order], weight[order]
    outputs_of_pixel = np.bincount(pixel, minlength=pixels)
    slot = np.arange(len(pixel)) - (np.cumsum(outputs_of_pixel) - outputs_of_pixel)[pixel]  # 0, 1, ... in each pixel
    shape = (outputs_of_pixel.max(), pixels)
    transposed = Taps(np.zeros(shape, np.int32), np.zeros(shape, np.float32))
    transposed.pixel[slot, pixel], transposed.weight[slot, pixel] = output, weight
    return transposed


def resample(flat: Float[Array, "b p c"], taps: Taps) -> Float[Array, "b n c"]:
    """Return images resampled by the table `taps`: n weighted sums of the p pixels of each flattened image."""
    products = (flat[:, pixel] * weight[None, :, None] for pixel, weight in zip(*taps, strict=True))
    return functools.reduce(jnp.add, products)
