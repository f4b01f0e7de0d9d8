"""Spectra of density images: preparation for the comparison, and correlation of two images at all poses."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Float32, Int, Num
from scipy.fft import next_fast_len

from sglpr_jax.bev import centre_crop, rotate_image
from sglpr_jax.grid import DENSITY_RESOLUTION_M
from sglpr_jax.registration.bev_config import VerificationConfig

DEFAULT = VerificationConfig()
AnyArray = Array | np.ndarray


def within_reach(image: Num[AnyArray, "h w"], config: VerificationConfig = DEFAULT) -> Num[AnyArray, "m m"]:
    """Crop the central square of an image that covers `config.reach_m`. m is a multiple of `2 * config.coarse`.

    Raises ValueError if the image is not square or has an odd number of cells per side.
    """
    if image.shape[0] != image.shape[1] or image.shape[0] % 2:
        raise ValueError(f"expected a square image of an even number of cells, found {image.shape}")
    size = min(2 * cell_count(config.reach_m, DENSITY_RESOLUTION_M), image.shape[0])
    size = max(size - size % (2 * config.coarse), 2 * config.coarse)
    return centre_crop(image, height=size, width=size)


def prepare_image(image: Num[AnyArray, "h w"], config: VerificationConfig) -> Float[Array, "m m"]:
    """Square roots of the counts `within_reach`. Cells outside of the circle of radius `config.reach_m` are zero."""
    centre = within_reach(image, config)
    size = centre.shape[0]
    axis_m = (np.arange(size) - (size - 1) / 2) * DENSITY_RESOLUTION_M
    inside = np.hypot(axis_m[:, None], axis_m[None]) < min(config.reach_m, size / 2 * DENSITY_RESOLUTION_M)
    return jnp.where(inside, jnp.sqrt(jnp.maximum(jnp.asarray(centre, jnp.float32), 0)), 0)


def merge_cells(image: Float[Array, "m m"], side: int) -> Float[Array, "k k"]:
    """Average pooling over squares of `side` x `side` cells."""
    size = image.shape[0] // side
    return image.reshape(size, side, size, side).mean((1, 3))


def cell_count(length_m: float, cell_m: float) -> int:
    """Number of cells of `cell_m` metres that cover a length in metres."""
    return int(np.ceil(length_m / cell_m))


@functools.partial(jax.jit, static_argnames="config")
def query_spectra(query: Num[AnyArray, "h w"], *, config: VerificationConfig = DEFAULT) -> Complex[Array, "s t f"]:
    """Compute the spectra of a rotated query, for `search`.

    The query is a square image of counts in the orientation of eq. 1. Its cells are merged, `config.coarse` per side.
    The axes of the result are row frequency, rotation (the first half of `config.turns`) and column frequency.
    `correlations` computes the other half turn from these. Raises the ValueError of `within_reach`.
    """
    angles = np.arange(config.turns // 4, dtype=np.float32) * np.float32(2 * np.pi / config.turns)
    images = rotate(merge_cells(prepare_image(query, config), config.coarse), jnp.asarray(angles))
    first_quarter = spectrum(images, DENSITY_RESOLUTION_M * config.coarse, config)
    return jnp.concatenate([first_quarter, _rotate_by_90_degrees(first_quarter)]).swapaxes(0, 1)


@functools.partial(jax.jit, static_argnames="config")
def match_spectra(matches: Num[AnyArray, "k h w"], *, config: VerificationConfig = DEFAULT) -> Complex[Array, "k s f"]:
    """Compute spectra of images for `search`, by image, row frequency and column frequency. See `query_spectra`."""

    def image_spectrum(image: Num[Array, "h w"]) -> Complex[Array, "s f"]:
        merged = merge_cells(prepare_image(image, config), config.coarse)
        return spectrum(merged[None], DENSITY_RESOLUTION_M * config.coarse, config)[0]

    return jax.lax.map(image_spectrum, jnp.asarray(matches))


def rotate(image: Float[Array, "m m"], angles: Float[Array, " t"]) -> Float[Array, "t m m"]:
    """Rotate an image by each angle, in radians."""
    # One by one: XLA would compile all at once into the padding of the next transform, which takes four times as long.
    return jax.lax.map(lambda angle: rotate_image(image, angle), angles)


def spectrum(images: Float[Array, "t m m"], cell_m: float, config: VerificationConfig) -> Complex[Array, "t s f"]:
    """Band-pass filtered Fourier transforms of images with cells of `cell_m` metres, scaled to unit power.

    Images are padded with zeros, so that no shift up to `config.max_shift_m` wraps around.
    """
    cells = images.shape[-1]
    size = fast_size(cells + cell_count(config.max_shift_m, cell_m))
    rows, columns = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    centring = np.exp(1j * np.pi * (cells - 1) * (rows + columns))  # moves the origin to the centre of the image
    factors = _band_pass(rows, columns, cell_m, config) * centring
    return _unit_power(jnp.fft.rfft2(images, (size, size)) * factors[None].astype(np.complex64))


def lower_half(spectra: Complex[Array, "*k s f"], config: VerificationConfig) -> Complex[Array, "*k r g"]:
    """Spectra of the same images on cells twice as large and with blurs twice as wide.

    They are the lower half of the frequencies, with the band-pass of the input replaced by one whose blurs are twice as
    wide in metres. Frequencies are in cycles per output cell, which are twice those per input cell.
    """
    size, cell_m = spectra.shape[-2] // 2, DENSITY_RESOLUTION_M * config.coarse
    rows, columns = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    old_filter = _band_pass(rows / 2, columns / 2, cell_m, config)
    new_filter = _band_pass(rows, columns, cell_m, config)
    is_used = (np.abs(rows) < 0.5) & (columns < 0.5) & (old_filter > 0)
    factors = np.where(is_used, new_filter / np.where(is_used, old_filter, 1), 0).astype(np.float32)
    low_columns = spectra[..., : size // 2 + 1]
    low = jnp.concatenate([low_columns[..., : size // 2, :], low_columns[..., -(size // 2) :, :]], axis=-2)
    return _unit_power(low * jnp.broadcast_to(factors, low.shape))


def fast_size(least: int) -> int:
    """Smallest multiple of four of at least `least` whose Fourier transform is fast."""
    size: Any = next_fast_len(least, real=True)  # typed as None
    return int(size) if size % 4 == 0 else fast_size(size + 1)


def column_counts(size: int) -> Float32[np.ndarray, "1 f"]:
    """Number of times that each column of a half spectrum (`rfft2`) occurs in the full spectrum: once or twice."""
    return np.where(np.isin(np.arange(size // 2 + 1), (0, size / 2)), 1, 2).astype(np.float32)[None]


def _band_pass(
    rows: Float[np.ndarray, "s 1"], columns: Float[np.ndarray, "1 f"], cell_m: float, config: VerificationConfig
) -> Float[np.ndarray, "s f"]:
    """Response of the band-pass filter at row and column frequencies in cycles per cell."""
    exponent = 2 * (np.pi / cell_m) ** 2 * (rows**2 + columns**2)
    return np.exp(-exponent * config.blur_m**2) - np.exp(-exponent * config.wide_blur_m**2)


def _unit_power(spectra: Complex[Array, "*k s f"]) -> Complex[Array, "*k s f"]:
    """Scale half spectra so that the sum of the squared cells of each image is 1."""
    size = spectra.shape[-2]
    weights = jnp.broadcast_to(column_counts(size), spectra.shape)
    power = jnp.sum(jnp.abs(spectra) ** 2 * weights, axis=(-2, -1), keepdims=True) / size**2
    return spectra / jnp.sqrt(jnp.maximum(power, 1e-9))


def _rotate_by_90_degrees(spectra: Complex[Array, "t s f"]) -> Complex[Array, "t s f"]:
    """Half spectra after a further rotation by 90 degrees: elements are reordered and change signs."""
    turns, size, width = spectra.shape
    index, conjugate, sign = _rotated_indices(size)
    values = spectra.reshape(turns, -1)[:, index]
    rotated = jax.lax.complex(values.real * sign[None], values.imag * (sign * conjugate)[None])
    return rotated.reshape(turns, size, width)


@functools.cache
def _rotated_indices(size: int) -> tuple[Int[np.ndarray, " n"], Float32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """Source of each element of a half spectrum that is rotated by 90 degrees.

    Row r and column c of the result are row c and column -r of the source. A half spectrum has no columns below 0, so
    these are read as conjugates of the opposite frequency. The frequencies size / 2 and -size / 2 share one row, but
    differ in sign, because the image is rotated about its centre, half a cell from the nearest cells. Returns the index
    into the flattened source, the factor of the imaginary part (-1 for conjugates), and the sign.
    """
    rows = np.rint(np.fft.fftfreq(size) * size).astype(int)[:, None]
    columns = np.arange(size // 2 + 1)[None]
    is_conjugate = (rows > 0) & (columns >= 0)
    index = np.where(is_conjugate, -columns, columns) % size * (size // 2 + 1) + np.abs(rows)
    sign = np.where(~is_conjugate & (columns == size // 2), -1, 1)
    conjugate = np.where(is_conjugate, -1, 1)
    return index.reshape(-1), conjugate.astype(np.float32).reshape(-1), sign.astype(np.float32).reshape(-1)


class Halves(NamedTuple):
    """Real and imaginary parts of spectra (row frequency, rotation, column frequency) by sign of the row frequency.

    This is the result of `query_spectra` in the form that `correlations` reads, made once for many matches.
    """

    positive: tuple[Float[Array, "h t f"], Float[Array, "h t f"]]
    """Row frequencies 0 to size / 2."""
    negative: tuple[Float[Array, "g t f"], Float[Array, "g t f"]]
    """Row frequencies -1, -2 and so on."""

    @classmethod
    def of(cls, spectra: Complex[Array, "s t f"]) -> "Halves":
        """Split spectra by the sign of the row frequency."""
        size = len(spectra)
        positive, negative = spectra[: size // 2 + 1], spectra[::-1][: (size - 1) // 2]
        return cls((positive.real, positive.imag), (negative.real, negative.imag))

    def at(self, rotations: Int[Array, " n"]) -> "Halves":
        """Select some rotations."""
        return jax.tree.map(lambda part: part[:, rotations], self)


def correlations(query: Halves, match: Complex[Array, "s f"], reach: int) -> Float[Array, "d _ d"]:
    """Correlation of a match with a query at many poses: by row shift, rotation and column shift.

    The t rotations of the query come first, then these plus 180 degrees.

    This is an inverse Fourier transform at few shifts, by matrix products. Even and odd parts are transformed
    separately, for shifts of zero and more: at the opposite shift the cosine is the same and the sine changes its sign.
    This takes a quarter of the multiplications of the full transform.

    Arguments:
      query: Spectra of the query at t rotations.
      match: One row of `match_spectra`.
      reach: Maximum shift in cells. Shifts run from -reach to reach, down and to the right.
    """
    size, (_, turns, width) = len(match), query.positive[0].shape
    row_cosines, row_sines, column_cosines, column_sines = map(jnp.asarray, _waves(reach, size))
    match_halves = Halves.of(match[:, None])
    positive = _products(match_halves.positive, query.positive)
    negative = _products(match_halves.negative, query.negative)
    # Row frequencies 0 and, if size is even, size / 2 have no negative partner.
    padding = ((1, len(positive[0]) - len(negative[0]) - 1), (0, 0), (0, 0))
    even = [plus + jnp.pad(minus, padding) for plus, minus in zip(positive, negative, strict=True)]
    odd = [plus[1 : len(minus) + 1] - minus for plus, minus in zip(positive, negative, strict=True)]
    cosine_real, cosine_imaginary = (row_cosines @ part.reshape(len(part), -1) for part in even)
    sine_real, sine_imaginary = (row_sines @ part.reshape(len(part), -1) for part in odd)
    real = _all_shifts(cosine_real, sine_imaginary, axis=0).reshape(-1, width)
    imaginary = _all_shifts(cosine_imaginary, -sine_real, axis=0).reshape(-1, width)
    values = _all_shifts(real @ column_cosines, imaginary @ column_sines, axis=1)
    return values.reshape(-1, 2 * turns, values.shape[1])


def _products(
    match: tuple[Float[Array, "h 1 f"], Float[Array, "h 1 f"]],
    query: tuple[Float[Array, "h t f"], Float[Array, "h t f"]],
) -> tuple[Float[Array, "h 2*t f"], Float[Array, "h 2*t f"]]:
    """Spectra of the correlations of a match with t query rotations, then with these rotations plus 180 degrees.

    Arguments and result are pairs of real and imaginary part. The correlation's spectrum is the match's times the
    conjugate of the query's. A rotation by 180 degrees conjugates the query's spectrum.
    """
    (a, b), (c, d) = match, query
    real = jnp.concatenate([a * c + b * d, a * c - b * d], axis=1)
    return real, jnp.concatenate([b * c - a * d, b * c + a * d], axis=1)


def _all_shifts(even: Float[Array, "a b"], odd: Float[Array, "a b"], *, axis: int) -> Float[Array, "*c"]:
    """Values at all shifts along `axis`, in ascending order, from even and odd part at shifts of 0 and more.

    The values are even + odd at negative shifts, and even - odd at the others.
    """
    at_negative_shifts = jnp.flip(jax.lax.slice_in_dim(even + odd, 1, None, axis=axis), axis)
    return jnp.concatenate([at_negative_shifts, even - odd], axis)


@functools.cache
def _waves(reach: int, size: int) -> tuple[Float32[np.ndarray, "_ _"], ...]:
    """Cosines and sines of an inverse Fourier transform at shifts from 0 to `reach` cells.

    Returns cosines and sines by row shift and row frequency, then cosines and sines by column frequency and column
    shift. Row frequencies are 0 to size / 2: the caller adds (cosines) or subtracts (sines) the values at the opposite
    frequencies first. Sines omit 0 and size / 2, which have no opposite. Column waves are scaled for the inverse
    transform of a half spectrum.
    """
    shifts, frequencies = np.arange(reach + 1), np.arange(size // 2 + 1)
    row_phases = 2 * np.pi / size * np.outer(shifts, frequencies)
    column_phases = 2 * np.pi / size * np.outer(frequencies, shifts)
    row_sines = np.sin(row_phases[:, 1 : (size - 1) // 2 + 1])
    scale = column_counts(size).T / size**2
    waves = np.cos(row_phases), row_sines, np.cos(column_phases) * scale, np.sin(column_phases) * scale
    return tuple(values.astype(np.float32) for values in waves)
