"""Bicubic resampling about the centre of square images, as in PyTorch: constant tables of 16 pixels and weights."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Float64, Int32

SHARPNESS = -0.75
"""Parameter a of the cubic kernel. PyTorch uses -0.75, `jax.image.resize` -0.5."""


class Taps(NamedTuple):
    """The 16 pixels around each point of a resampled image, by row and column, and their weights."""

    pixels: Int32[np.ndarray, "points 16"]
    """Index in the flattened image. Pixels outside have the weight 0."""
    weights: Float32[np.ndarray, "points 16"]


@functools.cache
def turned_taps(size: int, degrees: int) -> Taps:
    """Return the table that rotates an image of `size` x `size` pixels about its centre, with zeros outside.

    Arguments:
      size: Number of rows and of columns.
      degrees: Angle of the rotation, counter-clockwise as in `bev.rotate_image`.
    """
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    down, right = (np.mgrid[:size, :size] - (size - 1) / 2).reshape(2, -1)
    return _taps(np.stack([cos * down + sin * right, cos * right - sin * down]) + (size - 1) / 2, size)


def _taps(at: Float64[np.ndarray, "2 points"], size: int) -> Taps:
    """Return the table for points at the given rows and columns."""
    first = np.floor(at) - 1
    rows, columns = lines = first[..., None] + np.arange(4)
    down, right = cubic(lines - at[..., None]) * ((lines >= 0) & (lines < size))
    rows, columns = (line.clip(0, size - 1).astype(np.int32) for line in (rows, columns))
    pixels = rows[:, :, None] * size + columns[:, None]
    weights = (down[:, :, None] * right[:, None]).astype(np.float32)
    return Taps(pixels.reshape(-1, 16), weights.reshape(-1, 16))


def cubic(distance: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """Return the weight of a pixel at a distance in pixels, by the cubic convolution kernel."""
    x, a = np.abs(distance), SHARPNESS
    near = ((a + 2) * x - (a + 3)) * x**2 + 1
    far = a * (((x - 5) * x + 8) * x - 4)
    return np.where(x <= 1, near, np.where(x < 2, far, 0.0))


def resampled(images: Float[Array, "b h h"], taps: Taps) -> Float[Array, "b h h"]:
    """Return images resampled by a table of the same size."""
    flat = images.reshape(len(images), -1)
    parts = (flat[:, pixels] * weights[None] for pixels, weights in zip(taps.pixels.T, taps.weights.T, strict=True))
    return functools.reduce(jnp.add, parts).reshape(images.shape)


def resampled_maps(maps: Float[Array, "b h h c"], taps: Taps) -> Float[Array, "b h h c"]:
    """Return small maps of many channels resampled by a table, as a product with a dense matrix."""
    matrix = np.zeros((len(taps.pixels),) * 2, np.float32)
    np.add.at(matrix, (np.arange(len(matrix))[:, None], taps.pixels), taps.weights)
    return jnp.einsum("pq,bqc->bpc", matrix, maps.reshape(len(maps), -1, maps.shape[-1])).reshape(maps.shape)


def resized(maps: Float[Array, "b h h c"], size: int) -> Float[Array, "b {size} {size} c"]:
    """Return maps resampled to another size. The corners of both sizes coincide, and zeros surround the maps."""
    before = maps.shape[1]
    at = np.linspace(0, before - 1, size)
    along = cubic(at[:, None] - np.arange(before)).astype(np.float32)
    return jnp.einsum("ip,jq,bpqc->bijc", along, along, maps)
