"""The part of a density image that is compared, and its preparation for the comparison."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Float32, Int, Num
from scipy.fft import next_fast_len

from sglpr_jax.bev import centre_crop, rotate_image
from sglpr_jax.grid import DENSITY_RESOLUTION_M
from sglpr_jax.registration.config import VerificationConfig

DEFAULT = VerificationConfig()
AnyArray = Array | np.ndarray


def within_reach(image: Num[AnyArray, "h w"], config: VerificationConfig = DEFAULT) -> Num[AnyArray, "m m"]:
    """Central part of an image that is compared. m is a multiple of two merged cells.

    Raises ValueError if the image is not square or has an odd number of cells.
    """
    if image.shape[0] != image.shape[1] or image.shape[0] % 2:
        raise ValueError(f"expected a square image of an even number of cells, found {image.shape}")
    size = min(2 * cell_count(config.reach_m, DENSITY_RESOLUTION_M), image.shape[0])
    size = max(size - size % (2 * config.coarse), 2 * config.coarse)
    return centre_crop(image, height=size, width=size)


def prepare_image(image: Num[AnyArray, "h w"], config: VerificationConfig) -> Float[Array, "m m"]:
    """Square root of the counts within reach. Other cells are zero. Raises the error of `within_reach`."""
    centre = within_reach(image, config)
    size = centre.shape[0]
    axis_m = (np.arange(size) - (size - 1) / 2) * DENSITY_RESOLUTION_M
    inside = np.hypot(axis_m[:, None], axis_m[None]) < min(config.reach_m, size / 2 * DENSITY_RESOLUTION_M)
    return jnp.where(inside, jnp.sqrt(jnp.maximum(jnp.asarray(centre, jnp.float32), 0)), 0)


def merge_cells(image: Float[Array, "m m"], side: int) -> Float[Array, "k k"]:
    """Average pooling over squares of `side` cells."""
    size = image.shape[0] // side
    return image.reshape(size, side, size, side).mean((1, 3))


def cell_count(metres: float, cell_m: float) -> int:
    """Number of cells that cover a length, both in metres."""
    return int(np.ceil(metres / cell_m))


@functools.partial(jax.jit, static_argnames="config")
def query_spectra(query: Num[AnyArray, "h w"], *, config: VerificationConfig = DEFAULT) -> Complex[Array, "2 s t f"]:
    """Compute the spectra of a query on merged cells, at the t rotations of the first and of the second quarter turn.

    The image is square, of counts in the orientation of eq. 1. Raises the error of `within_reach`.
    """
    angles = np.arange(config.turns // 4, dtype=np.float32) * np.float32(2 * np.pi / config.turns)
    images = rotate(merge_cells(prepare_image(query, config), config.coarse), jnp.asarray(angles))
    first_quarter = spectrum(images, DENSITY_RESOLUTION_M * config.coarse, config)
    return jnp.stack([first_quarter, _rotate_by_90_degrees(first_quarter)]).transpose(0, 2, 1, 3)


@functools.partial(jax.jit, static_argnames="config")
def match_spectra(matches: Num[AnyArray, "k h w"], *, config: VerificationConfig = DEFAULT) -> Complex[Array, "k s f"]:
    """Compute the spectra of images on merged cells. Raises the error of `query_spectra`."""

    def image_spectrum(image: Num[Array, "h w"]) -> Complex[Array, "s f"]:
        small = merge_cells(prepare_image(image, config), config.coarse)
        return spectrum(small[None], DENSITY_RESOLUTION_M * config.coarse, config)[0]

    return jax.lax.map(image_spectrum, jnp.asarray(matches))


def rotate(image: Float[Array, "m m"], angles: Float[Array, " t"]) -> Float[Array, "t m m"]:
    """Rotate an image by each angle, in radians."""
    return rotate_image(jnp.broadcast_to(image, (len(angles), *image.shape)), angles)


def spectrum(images: Float[Array, "t m m"], cell_m: float, config: VerificationConfig) -> Complex[Array, "t s f"]:
    """Band-passed Fourier transforms of unit power, padded so that no shift up to `max_shift_m` wraps around."""
    size = fast_size(images.shape[-1] + cell_count(config.max_shift_m, cell_m))
    frequencies = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    phases = np.exp(1j * np.pi * (images.shape[-1] - 1) * (frequencies[0] + frequencies[1]))  # relative to the centre
    factors = _band_pass(*frequencies, cell_m, config) * phases
    return _unit_power(jnp.fft.rfft2(images, (size, size)) * factors[None].astype(np.complex64))


def lower_half(spectra: Complex[Array, "*k s f"], config: VerificationConfig) -> Complex[Array, "*k r g"]:
    """Spectra on cells twice as large, with blurs twice as wide, from the lower frequencies of other spectra."""
    size, cell_m = spectra.shape[-2] // 2, DENSITY_RESOLUTION_M * config.coarse
    rows, columns = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    present = _band_pass(rows / 2, columns / 2, cell_m, config)
    is_used = (np.abs(rows) < 0.5) & (columns < 0.5) & (present > 0)
    wider = _band_pass(rows, columns, cell_m, config)
    factors = np.where(is_used, wider / np.where(is_used, present, 1), 0).astype(np.float32)
    low = spectra[..., : size // 2 + 1]
    low = jnp.concatenate([low[..., : size // 2, :], low[..., -(size // 2) :, :]], axis=-2)
    return _unit_power(low * jnp.broadcast_to(factors, low.shape))


def fast_size(least: int) -> int:
    """Smallest multiple of four of at least `least` whose Fourier transform is fast."""
    size: Any = next_fast_len(least, real=True)  # typed as None
    return int(size) if size % 4 == 0 else fast_size(size + 1)


def column_counts(size: int) -> Float32[np.ndarray, "1 f"]:
    """Number of times that each column of the half spectrum of a real image occurs in the full spectrum."""
    return np.where(np.isin(np.arange(size // 2 + 1), (0, size / 2)), 1, 2).astype(np.float32)[None]


def _band_pass(
    rows: Float[np.ndarray, "s 1"], columns: Float[np.ndarray, "1 f"], cell_m: float, config: VerificationConfig
) -> Float[np.ndarray, "s f"]:
    """Response of the band-pass at frequencies in cycles a cell."""
    exponent = 2 * (np.pi / cell_m) ** 2 * (rows**2 + columns**2)
    return np.exp(-exponent * config.blur_m**2) - np.exp(-exponent * config.wide_blur_m**2)


def _unit_power(spectra: Complex[Array, "*k s f"]) -> Complex[Array, "*k s f"]:
    """Scale half spectra so that the power of each image is 1."""
    size = spectra.shape[-2]
    weights = jnp.broadcast_to(column_counts(size), spectra.shape)
    power = jnp.sum(jnp.abs(spectra) ** 2 * weights, axis=(-2, -1), keepdims=True) / size**2
    return spectra / jnp.sqrt(jnp.maximum(power, 1e-9))


def _rotate_by_90_degrees(spectra: Complex[Array, "t s f"]) -> Complex[Array, "t s f"]:
    """Spectra of images with an even number of cells a side, after a further rotation by 90 degrees."""
    t, size, width = spectra.shape
    index, conjugate, sign = _rotated_indices(size)
    values = spectra.reshape(t, -1)[:, index]
    return jax.lax.complex(values.real * sign[None], values.imag * (sign * conjugate)[None]).reshape(t, size, width)


@functools.cache
def _rotated_indices(size: int) -> tuple[Int[np.ndarray, " n"], Float32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """Value at row r and column c of a spectrum rotated by 90 degrees: that at row c and column -r.

    Columns below 0 are conjugates of the opposite frequencies. Row size / 2 is stored as row -size / 2, which changes
    the sign, because the centre of an even number of cells lies between two of them. Returns the index into the
    flattened half spectrum, the factor of the imaginary part (-1 for conjugates), and the sign.
    """
    rows = np.rint(np.fft.fftfreq(size) * size).astype(int)[:, None]
    columns = np.arange(size // 2 + 1)[None]
    opposite = (rows > 0) & (columns >= 0)
    index = np.where(opposite, -columns, columns) % size * (size // 2 + 1) + np.abs(rows)
    sign = np.where(~opposite & (columns == size // 2), -1, 1)
    conjugate = np.where(opposite, -1, 1)
    return index.reshape(-1), conjugate.astype(np.float32).reshape(-1), sign.astype(np.float32).reshape(-1)


class Halves(NamedTuple):
    """Real and imaginary parts of spectra: rows of frequencies 0 to s/2, and rows of frequencies -1, -2 and so on."""

    low: tuple[Float[Array, "h t f"], Float[Array, "h t f"]]
    high: tuple[Float[Array, "g t f"], Float[Array, "g t f"]]


def quarters(query: Complex[Array, "2 s t f"]) -> list[Halves]:
    """Convert the result of `query_spectra` to the input of `correlations`, once for many matches."""
    return [_halves(quarter) for quarter in query]


def correlations(query: list[Halves], match: Complex[Array, "s f"], reach: int) -> Float[Array, "d _ d"]:
    """Correlation of a match with every rotated query at every shift: rows down, rotations, columns to the right.

    The query is the result of `quarters`. `reach` is the maximum shift down and to the right, in cells.
    """
    first, second = (jnp.split(_quarter(half, match, reach), 2, axis=1) for half in query)
    return jnp.concatenate([first[0], second[0], first[1], second[1]], axis=1)


def _quarter(query: Halves, match: Complex[Array, "s f"], reach: int) -> Float[Array, "d _ d"]:
    """Correlations (see `correlations`) for t rotations, followed by these rotations plus 180 degrees.

    Even and odd parts are transformed separately, for shifts of zero and more. At the opposite shift the cosine is the
    same and the sine changes its sign. This takes a quarter of the multiplications of the full transform.
    """
    size, (_, turns, width) = len(match), query.low[0].shape
    cos_down, sin_down, cos_right, sin_right = map(jnp.asarray, _waves(reach, size))
    match_halves = _halves(match[:, None])
    low, high = _products(match_halves.low, query.low), _products(match_halves.high, query.high)
    unpaired = ((1, len(low[0]) - len(high[0]) - 1), (0, 0), (0, 0))
    even = [below + jnp.pad(above, unpaired) for below, above in zip(low, high, strict=True)]
    odd = [below[1 : len(above) + 1] - above for below, above in zip(low, high, strict=True)]
    cos_real, cos_imaginary = (cos_down @ part.reshape(len(part), -1) for part in even)
    sin_real, sin_imaginary = (sin_down @ part.reshape(len(part), -1) for part in odd)
    real = _all_shifts(cos_real, sin_imaginary, axis=0).reshape(-1, width)
    imaginary = _all_shifts(cos_imaginary, -sin_real, axis=0).reshape(-1, width)
    values = _all_shifts(real @ cos_right, imaginary @ sin_right, axis=1)
    return values.reshape(-1, 2 * turns, values.shape[1])


def _halves(spectra: Complex[Array, "s t f"]) -> Halves:
    size = len(spectra)
    low, high = spectra[: size // 2 + 1], spectra[::-1][: (size - 1) // 2]
    return Halves((low.real, low.imag), (high.real, high.imag))


def _products(
    match: tuple[Float[Array, "h 1 f"], Float[Array, "h 1 f"]],
    query: tuple[Float[Array, "h t f"], Float[Array, "h t f"]],
) -> tuple[Float[Array, "h 2*t f"], Float[Array, "h 2*t f"]]:
    """Products of a match's spectrum with the complex conjugates of the query's spectra, then with these spectra.

    Returns real and imaginary parts.
    """
    (a, b), (c, d) = match, query
    real = jnp.concatenate([a * c + b * d, a * c - b * d], axis=1)
    return real, jnp.concatenate([b * c - a * d, b * c + a * d], axis=1)


def _all_shifts(even: Float[Array, "a b"], odd: Float[Array, "a b"], *, axis: int) -> Float[Array, "*c"]:
    """Values at all shifts in ascending order: even + odd at negative shifts, even - odd at the others."""
    before = jnp.flip(jax.lax.slice_in_dim(even + odd, 1, None, axis=axis), axis)
    return jnp.concatenate([before, even - odd], axis)


@functools.cache
def _waves(reach: int, size: int) -> tuple[Float32[np.ndarray, "_ _"], ...]:
    """Cosines and sines: shifts from 0 to reach by frequencies down, and frequencies by shifts to the right.

    The second pair is scaled for the inverse transform of a half spectrum. The sines down omit the frequencies that are
    their own opposites.
    """
    shifts, rows, columns = np.arange(reach + 1), np.arange(size // 2 + 1), np.arange(size // 2 + 1)
    down, right = (2 * np.pi / size * np.outer(*pair) for pair in ((shifts, rows), (columns, shifts)))
    scale = column_counts(size).T / size**2
    sines = np.sin(down[:, 1 : (size - 1) // 2 + 1])
    waves = np.cos(down), sines, np.cos(right) * scale, np.sin(right) * scale
    return tuple(values.astype(np.float32) for values in waves)
