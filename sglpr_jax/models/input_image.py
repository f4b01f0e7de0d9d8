"""Conversion of an image of counts to network input: scaling, field of view and, if configured, polar resampling.

In a polar image, a rotation about the sensor is a shift. It has `radii` rows, the innermost first, and `sectors`
columns, counter-clockwise from the x axis. It covers the largest circle in the grid. Both directions are bilinear with
fixed weights: each value is a weighted sum of four others.
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
FEWEST_CELLS = 2
"""Minimum number of cells with points in an image that shows a place. All empty images have the same descriptor."""


def prepare(bev: Num[Array, "b h w"], config: ModelConfig) -> Float[Array, "b h w {config.channels}"]:
    """Convert point counts to network input.

    Counts are scaled as in `config.counts`, and cells outside the field of view are blank. A density image has floats,
    or uint8 grey values. Other integers are an error, because the fractions of the counts are lost.
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
    """Convert an image to the input of the backbone: polar if configured, and in the data type of the computation."""
    polar = to_polar(image, config.grid, *config.polar) if config.polar else image
    return polar.astype(config.compute)


def field_of_view(config: ModelConfig) -> Bool[np.ndarray, "1 h w"]:
    """Return the mask of cells that the network sees: within the field and at least `blind_m` from the sensor."""
    grid, distance = config.grid, cell_distance(config.grid)
    within = (distance < grid.resolution_m * min(grid.height, grid.width) / 2) | (config.field == "square")
    return (within & (distance >= config.blind_m))[None]


def cell_distance(grid: Grid) -> Float[np.ndarray, "h w"]:
    """Return the distance of each cell's centre from the sensor, in metres."""
    down, right = np.mgrid[: grid.height, : grid.width]
    cells = np.hypot(down - (grid.height - 1) / 2, right - (grid.width - 1) / 2)
    return (grid.resolution_m * cells).astype(np.float32)


class Taps(NamedTuple):
    """Source pixels of a resampling: each of n output values is a weighted sum of k pixels of the flattened image."""

    pixel: np.ndarray  # (k, n) int32
    weight: np.ndarray  # (k, n) float32


def to_polar(
    image: Float[Array, "b h w c"], grid: Grid, radii: int, sectors: int
) -> Float[Array, "b {radii} {sectors} c"]:
    """Sample the image along radii and sectors."""
    radius_cells = min(grid.height, grid.width) / 2
    radius = (np.arange(radii) + 0.5) * (radius_cells / radii)
    angle = (np.arange(sectors) + 0.5) * (2 * np.pi / sectors)
    row = (grid.height - 1) / 2 - np.outer(radius, np.sin(angle))
    column = (grid.width - 1) / 2 + np.outer(radius, np.cos(angle))
    taps = _bilinear(row.clip(0, grid.height - 1), column.clip(0, grid.width - 1), grid.height, grid.width)
    return resample(_flat(image), taps).reshape(image.shape[0], radii, sectors, -1)


def from_polar(polar: Float[Array, "b r s c"], grid: Grid) -> Float[Array, "b {grid.height} {grid.width} c"]:
    """Sample the polar image at every cell of the grid. Cells outside the circle are zero.

    The function is differentiable in reverse mode only. Its gradient is a gather, too, because the scatter of JAX's own
    gradient is six times slower on a CPU.
    """
    radii, sectors = polar.shape[1:3]
    down, right = np.mgrid[: grid.height, : grid.width]
    up, right = (grid.height - 1) / 2 - down, right - (grid.width - 1) / 2
    radius_cells = min(grid.height, grid.width) / 2
    radius = np.hypot(up, right) * (radii / radius_cells) - 0.5
    sector = np.arctan2(up, right) % (2 * np.pi) * (sectors / (2 * np.pi)) - 0.5
    taps = _bilinear(radius.clip(0, radii - 1), sector, radii, sectors)
    inside = (np.hypot(up, right) < radius_cells).reshape(-1)
    taps = Taps(taps.pixel, taps.weight * inside)
    back = _transposed(taps, radii * sectors)
    read = jax.custom_vjp(lambda flat: resample(flat, taps))
    read.defvjp(lambda flat: (resample(flat, taps), None), lambda _, cotangent: (resample(cotangent, back),))
    return read(_flat(polar)).reshape(polar.shape[0], grid.height, grid.width, -1)


def _flat(image: Float[Array, "b h w c"]) -> Float[Array, "b h*w c"]:
    return image.reshape(image.shape[0], -1, image.shape[-1])


def _bilinear(row: np.ndarray, column: np.ndarray, height: int, width: int) -> Taps:
    """The four pixels around each position. Rows must lie within the image; columns wrap around."""
    top, left = np.minimum(np.floor(row), height - 2).astype(np.int32), np.floor(column).astype(np.int32)
    down, right = row - top, column - left
    corners = [(dy, dx) for dy in (0, 1) for dx in (0, 1)]
    pixel = [(top + dy) * width + (left + dx) % width for dy, dx in corners]
    weight = [(down if dy else 1 - down) * (right if dx else 1 - right) for dy, dx in corners]
    return Taps(np.reshape(pixel, (4, -1)).astype(np.int32), np.reshape(weight, (4, -1)).astype(np.float32))


def _transposed(taps: Taps, pixels: int) -> Taps:
    """Taps of the gradient: the readers of each pixel, padded to the largest number of readers."""
    used = taps.weight > 0
    reader = np.broadcast_to(np.arange(taps.pixel.shape[1]), taps.pixel.shape)[used]
    pixel, weight = taps.pixel[used], taps.weight[used]
    order = np.argsort(pixel, kind="stable")
    pixel, reader, weight = pixel[order], reader[order], weight[order]
    readers = np.bincount(pixel, minlength=pixels)
    slot = np.arange(len(pixel)) - (np.cumsum(readers) - readers)[pixel]
    back = Taps(np.zeros((readers.max(), pixels), np.int32), np.zeros((readers.max(), pixels), np.float32))
    back.pixel[slot, pixel], back.weight[slot, pixel] = reader, weight
    return back


def resample(flat: Float[Array, "b p c"], taps: Taps) -> Float[Array, "b n c"]:
    """Return the weighted sums of the pixels in `taps`."""
    parts = (flat[:, pixel] * weight[None, :, None] for pixel, weight in zip(*taps, strict=True))
    return functools.reduce(jnp.add, parts)
