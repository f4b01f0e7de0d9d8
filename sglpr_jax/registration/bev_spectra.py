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
    size = min(2 * cells(config.reach_m, DENSITY_RESOLUTION_M), image.shape[0])
    size = max(size - size % (2 * config.coarse), 2 * config.coarse)
    return centre_crop(image, height=size, width=size)


def prepared(image: Num[AnyArray, "h w"], config: VerificationConfig) -> Float[Array, "m m"]:
    """Square root of the counts within reach. Other cells are zero. Raises the error of `within_reach`."""
    middle = within_reach(image, config)
    size = middle.shape[0]
    axis = (np.arange(size) - (size - 1) / 2) * DENSITY_RESOLUTION_M
    inside = np.hypot(axis[:, None], axis[None]) < min(config.reach_m, size / 2 * DENSITY_RESOLUTION_M)
    return jnp.where(inside, jnp.sqrt(jnp.maximum(jnp.asarray(middle, jnp.float32), 0)), 0)


def merged(image: Float[Array, "m m"], side: int) -> Float[Array, "k k"]:
    """Average pooling over squares of `side` cells."""
    size = image.shape[0] // side
    return image.reshape(size, side, size, side).mean((1, 3))


def cells(metres: float, cell_m: float) -> int:
    """Number of cells that cover a length, both in metres."""
    return int(np.ceil(metres / cell_m))


@functools.partial(jax.jit, static_argnames="config")
def query_spectra(query: Num[AnyArray, "h w"], *, config: VerificationConfig = DEFAULT) -> Complex[Array, "2 s t f"]:
    """Compute the spectra of a query on merged cells, at the t rotations of the first and of the second quarter turn.

    The image is square, of counts in the orientation of eq. 1. Raises the error of `within_reach`.
    """
    angles = np.arange(config.turns // 4, dtype=np.float32) * np.float32(2 * np.pi / config.turns)
    rotated = rotations(merged(prepared(query, config), config.coarse), jnp.asarray(angles))
    first = spectrum(rotated, DENSITY_RESOLUTION_M * config.coarse, config)
    return jnp.stack([first, _quarter_turned(first)]).transpose(0, 2, 1, 3)


@functools.partial(jax.jit, static_argnames="config")
def match_spectra(matches: Num[AnyArray, "k h w"], *, config: VerificationConfig = DEFAULT) -> Complex[Array, "k s f"]:
    """Compute the spectra of images on merged cells. Raises the error of `query_spectra`."""

    def one(image: Num[Array, "h w"]) -> Complex[Array, "s f"]:
        small = merged(prepared(image, config), config.coarse)
        return spectrum(small[None], DENSITY_RESOLUTION_M * config.coarse, config)[0]

    return jax.lax.map(one, jnp.asarray(matches))


def rotations(image: Float[Array, "m m"], angles: Float[Array, " t"]) -> Float[Array, "t m m"]:
    """Rotate an image by each angle, in radians."""
    return rotate_image(jnp.broadcast_to(image, (len(angles), *image.shape)), angles)


def spectrum(images: Float[Array, "t m m"], cell_m: float, config: VerificationConfig) -> Complex[Array, "t s f"]:
    """Band-passed Fourier transforms of unit power, padded so that no shift up to `max_shift_m` wraps around."""
    size = fast_size(images.shape[-1] + cells(config.max_shift_m, cell_m))
    frequencies = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    factors = _band(*frequencies, cell_m, config) * _centred(*frequencies, images.shape[-1])
    return _unit_power(jnp.fft.rfft2(images, (size, size)) * factors[None].astype(np.complex64))


def lower_half(spectra: Complex[Array, "*k s f"], config: VerificationConfig) -> Complex[Array, "*k r g"]:
    """Spectra on cells twice as large, with blurs twice as wide, from the lower frequencies of other spectra."""
    size, cell_m = spectra.shape[-2] // 2, DENSITY_RESOLUTION_M * config.coarse
    rows, columns = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    before, after = _band(rows / 2, columns / 2, cell_m, config), _band(rows, columns, cell_m, config)
    kept = (np.abs(rows) < 0.5) & (columns < 0.5) & (before > 0)
    factors = np.where(kept, after / np.where(kept, before, 1), 0).astype(np.float32)
    low = spectra[..., : size // 2 + 1]
    low = jnp.concatenate([low[..., : size // 2, :], low[..., -(size // 2) :, :]], axis=-2)
    return _unit_power(low * jnp.broadcast_to(factors, low.shape))


def fast_size(least: int) -> int:
    """Smallest multiple of four of at least `least` whose Fourier transform is fast."""
    size: Any = next_fast_len(least, real=True)  # typed as None
    return int(size) if size % 4 == 0 else fast_size(size + 1)


def twice(size: int) -> Float32[np.ndarray, "1 f"]:
    """Number of times that each column of the half spectrum of a real image occurs in the full spectrum."""
    return np.where(np.isin(np.arange(size // 2 + 1), (0, size / 2)), 1, 2).astype(np.float32)[None]


def _band(
    rows: Float[np.ndarray, "s 1"], columns: Float[np.ndarray, "1 f"], cell_m: float, config: VerificationConfig
) -> Float[np.ndarray, "s f"]:
    """Response of the band-pass at frequencies in cycles a cell."""
    exponent = 2 * (np.pi / cell_m) ** 2 * (rows**2 + columns**2)
    return np.exp(-exponent * config.blur_m**2) - np.exp(-exponent * config.wide_blur_m**2)


def _centred(
    rows: Float[np.ndarray, "s 1"], columns: Float[np.ndarray, "1 f"], side: int
) -> Complex[np.ndarray, "s f"]:
    """Factors that make phases relative to the centre of an image of `side` cells."""
    return np.exp(1j * np.pi * (side - 1) * (rows + columns))


def _unit_power(spectra: Complex[Array, "*k s f"]) -> Complex[Array, "*k s f"]:
    size = spectra.shape[-2]
    weights = jnp.broadcast_to(twice(size), spectra.shape)
    power = jnp.sum(jnp.abs(spectra) ** 2 * weights, axis=(-2, -1), keepdims=True) / size**2
    return spectra / jnp.sqrt(jnp.maximum(power, 1e-9))


def _quarter_turned(spectra: Complex[Array, "t s f"]) -> Complex[Array, "t s f"]:
    """Spectra of images with an even number of cells a side, after a further rotation by 90 degrees."""
    t, size, width = spectra.shape
    index, conjugate, sign = _sources(size)
    found = spectra.reshape(t, -1)[:, index]
    return jax.lax.complex(found.real * sign[None], found.imag * (sign * conjugate)[None]).reshape(t, size, width)


@functools.cache
def _sources(size: int) -> tuple[Int[np.ndarray, " n"], Float32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
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
    """The result of `query_spectra` as `correlations` takes it. It is computed once for many matches."""
    return [_halves(quarter) for quarter in query]


def correlations(query: list[Halves], match: Complex[Array, "s f"], reach: int) -> Float[Array, "d _ d"]:
    """Correlation of a match with every rotated query at every shift: rows down, rotations, columns to the right.

    The query is the result of `quarters`. `reach` is the maximum shift down and to the right, in cells.
    """
    first, second = (jnp.split(_quarter(half, match, reach), 2, axis=1) for half in query)
    return jnp.concatenate([first[0], second[0], first[1], second[1]], axis=1)


def _quarter(query: Halves, match: Complex[Array, "s f"], reach: int) -> Float[Array, "d _ d"]:
    """The same for t rotations, followed by these rotations plus 180 degrees.

    Even and odd parts are transformed separately, for shifts of zero and more. At the opposite shift the cosine is the
    same and the sine changes its sign. This takes a quarter of the multiplications of the full transform.
    """
    size, (_, turns, width) = len(match), query.low[0].shape
    cos_down, sin_down, cos_right, sin_right = map(jnp.asarray, _waves(reach, size))
    there = _halves(match[:, None])
    low, high = _products(there.low, query.low), _products(there.high, query.high)
    unpaired = ((1, len(low[0]) - len(high[0]) - 1), (0, 0), (0, 0))
    even = [one + jnp.pad(other, unpaired) for one, other in zip(low, high, strict=True)]
    odd = [one[1 : len(other) + 1] - other for one, other in zip(low, high, strict=True)]
    cos_real, cos_imaginary = (cos_down @ part.reshape(len(part), -1) for part in even)
    sin_real, sin_imaginary = (sin_down @ part.reshape(len(part), -1) for part in odd)
    real = _both_ways(cos_real, sin_imaginary, axis=0).reshape(-1, width)
    imaginary = _both_ways(cos_imaginary, -sin_real, axis=0).reshape(-1, width)
    found = _both_ways(real @ cos_right, imaginary @ sin_right, axis=1)
    return found.reshape(-1, 2 * turns, found.shape[1])


def _halves(spectra: Complex[Array, "s t f"]) -> Halves:
    size = len(spectra)
    low, high = spectra[: size // 2 + 1], spectra[::-1][: (size - 1) // 2]
    return Halves((low.real, low.imag), (high.real, high.imag))


def _products(
    match: tuple[Float[Array, "h 1 f"], Float[Array, "h 1 f"]],
    query: tuple[Float[Array, "h t f"], Float[Array, "h t f"]],
) -> tuple[Float[Array, "h 2*t f"], Float[Array, "h 2*t f"]]:
    """Real and imaginary parts of a match's spectrum times the complex conjugates of the query's spectra, and times
    these spectra themselves."""
    (a, b), (c, d) = match, query
    real = jnp.concatenate([a * c + b * d, a * c - b * d], axis=1)
    return real, jnp.concatenate([b * c - a * d, b * c + a * d], axis=1)


def _both_ways(even: Float[Array, "a b"], odd: Float[Array, "a b"], *, axis: int) -> Float[Array, "*c"]:
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
    often = twice(size).T / size**2
    sines = np.sin(down[:, 1 : (size - 1) // 2 + 1])
    found = np.cos(down), sines, np.cos(right) * often, np.sin(right) * often
    return tuple(values.astype(np.float32) for values in found)
