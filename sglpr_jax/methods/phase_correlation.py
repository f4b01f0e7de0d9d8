"""Alignment of two images in LiDAR Iris: first rotation and scale, then translation (Reddy and Chatterji, 1996)."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Complex, Float, Float32, Int

LARGEST_SCALE = 1.8
"""Maximum scale. A larger one is considered the inverse of the true scale."""
NEAR = 2
"""Distance from the peak, in cells, within which its centre of mass is computed."""
SMALL = float(np.finfo(np.float32).eps)
"""Added to squared amplitudes before division, so that faint frequencies have less weight."""


class Spectra(NamedTuple):
    """An image, its spectrum, and the spectrum of its log-polar amplitudes."""

    image: Float[Array, "*n rows columns"]
    spectrum: Complex[Array, "*n rows frequencies"]
    log_polar: Complex[Array, "*n rows frequencies"]


@jax.jit
def spectra(images: Float[Array, "n rows columns"]) -> Spectra:
    """Return the spectra of images with an even number of rows and columns."""
    filtered = _high_pass(*images.shape[1:])
    places = list(_log_polar_places(*images.shape[1:]))

    def of_one(image):
        amplitudes = jnp.fft.fftshift(jnp.abs(jnp.fft.fft2(image))) / image.size * filtered
        return Spectra(image, jnp.fft.rfft2(image), jnp.fft.rfft2(map_coordinates(amplitudes, places, order=1)))

    return jax.lax.map(of_one, images)


@jax.jit
def column_shifts(queries: Spectra, database: Spectra) -> Int[Array, "q n 2"]:
    """Return two estimates of the shift to the right, in columns, that aligns each query with each image of the
    database.

    The query is first rotated and scaled according to the log-polar spectra. The first estimate is the position of the
    correlation peak, rounded towards 0. For the second, the database image is rolled by half its columns, and the
    result is corrected for the roll. The peak is the same, but it is rounded in the opposite direction and may be cut
    by the border.
    """

    def shifts(query, other):
        turned = jnp.fft.rfft2(_turned_and_scaled(query.image, *turn_and_scale(query, other)))
        surface = _correlation(turned, other.spectrum, query.image.shape)
        rows, columns = surface.shape
        half = columns // 2
        here, opposite = (_peak(surface, (rows // 2, by))[1] for by in (half, 0))
        return jnp.stack([here, opposite]).astype(jnp.int32) - jnp.array([0, half])

    return jax.lax.map(lambda query: jax.lax.map(lambda other: shifts(query, other), database), queries)


def turn_and_scale(query: Spectra, other: Spectra) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the rotation that aligns the query, in radians, and the size of the query relative to the other image."""
    rows, columns = query.image.shape
    correlation = _correlation(query.log_polar, other.log_polar, (rows, columns))
    down, right = _peak(correlation, (rows // 2, columns // 2))
    angle, scale = jnp.pi * down / rows, _log_base(rows, columns) ** right
    inverse = scale > LARGEST_SCALE
    return jnp.where(inverse, -angle, angle), jnp.where(inverse, 1 / scale, scale)


def _correlation(
    a: Complex[Array, "rows frequencies"], b: Complex[Array, "rows frequencies"], shape: tuple[int, int]
) -> Float[Array, "rows columns"]:
    """Return the phase correlation. The offset of its peak from the corner is the shift that moves b onto a."""
    cross = a * jnp.conj(b)
    size = jnp.abs(cross)
    return jnp.fft.irfft2(cross * size / (size**2 + SMALL), shape)


def _peak(surface: Float[Array, "rows columns"], rolled: tuple[int, int]) -> Float[Array, "2"]:
    """Return the offset of the middle, down and right, from the centre of mass of the peak.

    The offset is measured in the surface rolled by `rolled` rows and columns. Borders of this surface cut the peak.
    """
    shape = np.array(surface.shape)
    peak = jnp.stack(jnp.divmod(_argmax(surface), surface.shape[1]))
    place = (peak + np.array(rolled)) % shape
    steps = np.arange(-NEAR, NEAR + 1)
    row, column = (peak[:, None] + steps[None]) % shape[:, None]
    inside = (place[:, None] + steps[None] >= 0) & (place[:, None] + steps[None] < shape[:, None])
    window = jnp.where(inside[0][:, None] & inside[1][None], surface[row[:, None], column[None]], 0.0)
    total = window.sum()
    mean = jnp.stack([window.sum(axis=1) @ steps, window.sum(axis=0) @ steps]) / jnp.where(total == 0, 1.0, total)
    return jnp.asarray(shape // 2) - place - mean


def _argmax(values: Float[Array, "rows columns"]) -> Int[Array, ""]:
    """Return the same as `jnp.argmax`, in an eighth of its time on a CPU."""
    return jnp.where(values.ravel() == values.max(), jnp.arange(values.size), values.size).min()


def _turned_and_scaled(
    image: Float[Array, "rows columns"], angle: Float[Array, ""], scale: Float[Array, ""]
) -> Float[Array, "rows columns"]:
    """Return the image, rotated about its middle and shrunk by `scale`, with zeros outside."""
    rows, columns = image.shape
    down, right = jnp.meshgrid(jnp.arange(rows) - rows // 2, jnp.arange(columns) - columns // 2, indexing="ij")
    cos, sin = scale * jnp.cos(angle), scale * jnp.sin(angle)
    places = [rows // 2 + sin * right + cos * down, columns // 2 + cos * right - sin * down]
    return map_coordinates(image, places, order=1)


def _log_base(rows: int, columns: int) -> float:
    """Return the ratio of the radii of neighbouring columns of a log-polar image. The corner follows the last
    column."""
    return float(np.hypot(rows // 2, columns // 2) ** (1 / columns))


@functools.cache
def _log_polar_places(rows: int, columns: int) -> Float32[np.ndarray, "2 rows columns"]:
    """Return row and column of each cell of a log-polar image. Its rows are angles over half a revolution, its columns
    radii."""
    angle = np.pi / 2 + np.pi * np.arange(rows)[:, None] / rows
    radius = _log_base(rows, columns) ** np.arange(columns)[None, :]
    return np.stack([rows // 2 + radius * np.cos(angle), columns // 2 + radius * np.sin(angle)]).astype(np.float32)


@functools.cache
def _high_pass(rows: int, columns: int) -> Float32[np.ndarray, "rows columns"]:
    """Return the gain (1 - c) (2 - c) of each frequency, where c is the product of two half cosines. It is 0 in the
    middle."""
    down, right = (np.cos(np.pi * (np.arange(size) / size - 0.5)) for size in (rows, columns))
    product = np.outer(down, right)
    return ((1 - product) * (2 - product)).astype(np.float32)
