"""Band-passed Fourier spectra of images, whose products are correlations.

The band-pass is the difference of a narrow and a wide blur. It keeps structures as wide as a wall, a pole or a trunk.
Without it, one street looks like any other. Phases are relative to the centre of the image. Then the spectrum of an
image that is rotated by 180 degrees is the complex conjugate, and a rotation by 90 degrees exchanges the axes. A
quarter of the rotations of a query is therefore computed from the image, and the others follow.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Float32, Int, Num
from scipy.fft import next_fast_len

from sglpr_jax.bev import rotate_image
from sglpr_jax.loops.compared_image import DEFAULT, AnyArray, cells, merged, prepared
from sglpr_jax.loops.config import VerificationConfig


@functools.partial(jax.jit, static_argnames="config")
def query_spectra(query: Num[AnyArray, "h w"], *, config: VerificationConfig = DEFAULT) -> Complex[Array, "2 s t f"]:
    """Compute the spectra of a query on merged cells, at the t rotations of the first and of the second quarter turn.

    Arguments:
      query: Square image of counts in the orientation of eq. 1, with an even number of cells per side.
      config: Settings of the comparison.

    Raises:
      ValueError: If the image is not square or has an odd number of cells.
    """
    angles = np.arange(config.turns // 4, dtype=np.float32) * np.float32(2 * np.pi / config.turns)
    rotated = rotations(merged(prepared(query, config), config.coarse), jnp.asarray(angles))
    first = spectrum(rotated, config.resolution_m * config.coarse, config)
    return jnp.stack([first, _quarter_turned(first)]).transpose(0, 2, 1, 3)


@functools.partial(jax.jit, static_argnames="config")
def match_spectra(matches: Num[AnyArray, "k h w"], *, config: VerificationConfig = DEFAULT) -> Complex[Array, "k s f"]:
    """Compute the spectra of images on merged cells. Raises the error of `query_spectra`."""

    def one(image: Num[Array, "h w"]) -> Complex[Array, "s f"]:
        small = merged(prepared(image, config), config.coarse)
        return spectrum(small[None], config.resolution_m * config.coarse, config)[0]

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
    size, cell_m = spectra.shape[-2] // 2, config.resolution_m * config.coarse
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
    the sign, because the centre of an even number of cells lies between two of them.

    Returns:
      Index into the flattened half spectrum, factor of the imaginary part (-1 for conjugates), and sign.
    """
    rows = np.rint(np.fft.fftfreq(size) * size).astype(int)[:, None]
    columns = np.arange(size // 2 + 1)[None]
    opposite = (rows > 0) & (columns >= 0)
    index = np.where(opposite, -columns, columns) % size * (size // 2 + 1) + np.abs(rows)
    sign = np.where(~opposite & (columns == size // 2), -1, 1)
    conjugate = np.where(opposite, -1, 1)
    return index.reshape(-1), conjugate.astype(np.float32).reshape(-1), sign.astype(np.float32).reshape(-1)
