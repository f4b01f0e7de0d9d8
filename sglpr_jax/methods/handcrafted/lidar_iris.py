"""LiDAR Iris (Wang et al., 2020): a polar image whose binary texture is compared by a shifted Hamming distance."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Complex, Complex128, Float, Float32, Float64, Int, UInt64

from sglpr_jax.methods.cells import polar
from sglpr_jax.methods.pairwise import in_blocks

RINGS = 80
COLUMNS = 360
RING_M = 1.0
HEIGHT_BITS = 8
LOWEST_DEG = -24.0
"""Elevation at which the first height bit begins, for the HDL-64E. A 16-beam sensor would need -15."""
BIT_DEG = 4.0

WAVELENGTHS = tuple(18 * 1.6**scale for scale in range(4))
"""Wavelengths of the four log-Gabor filters, in columns."""
SIGMA = 0.75
"""Width of a filter: its standard deviation divided by its frequency."""
FAINT_AMPLITUDE = 1e-4 / COLUMNS
"""Amplitude below which a sign is unreliable. The published 1e-4 is for an inverse transform without 1 / columns."""
NEARBY_SHIFTS = 2
"""Number of shifts to either side of each estimated shift that are also compared, in columns."""

LARGEST_SCALE = 1.8
"""Maximum estimated scale. A larger one is considered the inverse of the true scale."""
PEAK_CELLS = 2
"""Distance from the peak, in cells, within which its centre of mass is computed."""
SMALL = float(np.finfo(np.float32).eps)
"""Added to squared amplitudes before division, so that faint frequencies have less weight."""
LOG_BASE = float(np.hypot(RINGS // 2, COLUMNS // 2) ** (1 / COLUMNS))
"""Ratio of the radii of neighbouring columns of the log-polar spectrum."""

BLOCK = 128


def lidar_iris(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "28800"]:
    """Return the LiDAR-Iris image, 80 rings of 1 m x 360 degrees, flattened: integers from 0 to 255.

    Bit k of a pixel is set if the pixel has a point (metres, z up) whose elevation is k to k + 1 times 4 degrees above
    -24 degrees. Elevations and ranges beyond the limits count in the nearest bit and ring. Column 180 is the x axis,
    and azimuths are rounded to the nearest column, at most 359.
    """
    radius, azimuth, z = polar(points)
    ring = np.minimum(radius / RING_M, RINGS - 1).astype(np.int64)
    column = np.minimum(180 + np.degrees(azimuth) + 0.5, COLUMNS - 1).astype(np.int64)
    elevation = np.degrees(np.arctan2(z, radius))
    bit = np.clip((elevation - LOWEST_DEG) / BIT_DEG, 0, HEIGHT_BITS - 1).astype(np.int64)
    image = np.zeros(RINGS * COLUMNS, np.int64)
    np.bitwise_or.at(image, ring * COLUMNS + column, 1 << bit)
    return image.astype(np.float32)


class Spectra(NamedTuple):
    """An image, its spectrum, and the spectrum of its log-polar amplitudes."""

    image: Float[Array, "*n 80 360"]
    spectrum: Complex[Array, "*n 80 181"]
    log_polar: Complex[Array, "*n 80 181"]


Bits = UInt64[np.ndarray, "... 360 words"]
"""Bits of each column, for all rings, filters and parts (real and imaginary), packed into integers of 64 bits."""


def lidar_iris_distance(
    queries: Float32[np.ndarray, "q 28800"], database: Float32[np.ndarray, "n 28800"]
) -> Float32[np.ndarray, "q n"]:
    """Return the smallest fraction of unequal bits, over the shifts within 2 columns of the two of `column_shifts`.

    The bits are the signs of the real and the imaginary part of the log-Gabor responses: 80 x 360 pixels x 4 filters x
    2 parts. Bits of responses that are faint in either image do not count. If all are faint, the distance is 1.
    """

    def compare(queries, database):
        (query_spectra, query_bits, query_faint), (database_spectra, database_bits, database_faint) = queries, database
        shifts = np.asarray(column_shifts(query_spectra, database_spectra))
        distances = [
            _hamming_distances(bits, faint, query_shifts, database_bits, database_faint)
            for bits, faint, query_shifts in zip(query_bits, query_faint, shifts, strict=True)
        ]
        return np.stack(distances)

    return in_blocks(compare, queries, database, block=BLOCK, prepare=_prepare, threads=None)


def log_gabor_responses(image: Float64[np.ndarray, "80 360"]) -> Complex128[np.ndarray, "filters 80 360"]:
    """Return the complex responses of every ring to the log-Gabor filters exp(-ln(f w)^2 / (2 ln(sigma)^2)), f > 0."""
    frequency = np.fft.fftfreq(COLUMNS)
    is_positive = frequency > 0
    gains = np.zeros((len(WAVELENGTHS), COLUMNS))
    log_ratio = np.log(np.outer(WAVELENGTHS, frequency[is_positive]))
    gains[:, is_positive] = np.exp(-(log_ratio**2) / (2 * np.log(SIGMA) ** 2))
    return np.fft.ifft(np.fft.fft(image)[None] * gains[:, None])


def _prepare(descriptors: Float32[np.ndarray, "n 28800"]) -> tuple[Spectra, Bits, Bits]:
    """Return the spectra of the images, the signs of their log-Gabor responses, and a mask of the faint responses."""

    def pack(bits):  # parts, filters, 80, 360
        return np.ascontiguousarray(np.packbits(bits.reshape(-1, COLUMNS).T, axis=-1)).view(np.uint64)

    images = descriptors.reshape(-1, RINGS, COLUMNS)
    signs, faint = [], []
    for image in images:
        response = log_gabor_responses(image.astype(np.float64))
        is_faint = np.abs(response) < FAINT_AMPLITUDE
        signs.append(pack(np.stack([np.real(response) > 0, np.imag(response) > 0])))
        faint.append(pack(np.stack([is_faint, is_faint])))
    return spectra(jnp.asarray(images) / 255), np.stack(signs), np.stack(faint)


def _hamming_distances(
    bits: Bits, faint: Bits, shifts: Int[np.ndarray, "n 2"], database_bits: Bits, database_faint: Bits
) -> Float[np.ndarray, " n"]:
    """Return the distance of one query to each database image, at the best shift near the two estimated `shifts`."""
    nearby = shifts[..., None] + np.arange(-NEARBY_SHIFTS, NEARBY_SHIFTS + 1)
    candidates = np.sort(nearby.reshape(len(shifts), -1) % COLUMNS, axis=1)  # database image, shift
    is_first = np.diff(candidates, axis=1, prepend=-1) > 0  # most shifts occur twice, near both estimates
    smallest = np.ones(len(shifts))
    for i in range(candidates.shape[1]):
        images = np.flatnonzero(is_first[:, i])
        columns = (np.arange(COLUMNS) + candidates[images, i, None]) % COLUMNS
        shifted = images[:, None], columns
        is_counted = ~(faint | database_faint[shifted])
        unequal_bits = np.bitwise_count((bits ^ database_bits[shifted]) & is_counted).sum(axis=(1, 2), dtype=np.int64)
        all_bits = np.bitwise_count(is_counted).sum(axis=(1, 2), dtype=np.int64)
        distances = np.divide(unequal_bits, all_bits, out=np.ones(len(images)), where=all_bits > 0)
        smallest[images] = np.minimum(smallest[images], distances)
    return smallest


@jax.jit
def spectra(images: Float[Array, "n 80 360"]) -> Spectra:
    """Return the spectra of images.

    The log-polar image has 80 angles (half a turn) x 360 radii. The amplitudes are first multiplied by a gain that
    suppresses low frequencies.
    """
    row_cosine, column_cosine = (np.cos(np.pi * (np.arange(size) / size - 0.5)) for size in (RINGS, COLUMNS))
    lowness = np.outer(row_cosine, column_cosine)  # 1 at frequency 0, 0 at the highest frequencies
    gain = ((1 - lowness) * (2 - lowness)).astype(np.float32)
    angle = np.pi / 2 + np.pi * np.arange(RINGS)[:, None] / RINGS
    radius = LOG_BASE ** np.arange(COLUMNS)[None, :]
    pixels = np.stack([RINGS // 2 + radius * np.cos(angle), COLUMNS // 2 + radius * np.sin(angle)]).astype(np.float32)

    def image_spectra(image):
        amplitudes = jnp.fft.fftshift(jnp.abs(jnp.fft.fft2(image))) / image.size * gain
        log_polar = map_coordinates(amplitudes, list(pixels), order=1)
        return Spectra(image, jnp.fft.rfft2(image), jnp.fft.rfft2(log_polar))

    return jax.lax.map(image_spectra, images)


@jax.jit
def column_shifts(queries: Spectra, database: Spectra) -> Int[Array, "q n 2"]:
    """Return two estimates of the shift to the right, in columns, that aligns each query with each database image.

    The query is first rotated and scaled according to the log-polar spectra. The first estimate is the position of the
    correlation peak, rounded towards 0. For the second, the database image is rolled by half its columns, so that the
    peak is rounded in the opposite direction and may be cut by the border.
    """

    def shifts(query, other):
        angle, scale = rotation_and_scale(query, other)
        aligned_spectrum = jnp.fft.rfft2(_rotate_and_scale(query.image, angle, scale))
        surface = _phase_correlation(aligned_spectrum, other.spectrum)
        _, first_estimate = _offset_of_peak(surface, (RINGS // 2, COLUMNS // 2))
        _, rolled_estimate = _offset_of_peak(surface, (RINGS // 2, 0))
        estimates = jnp.stack([first_estimate, rolled_estimate]).astype(jnp.int32)
        return estimates - jnp.array([0, COLUMNS // 2])

    return jax.lax.map(lambda query: jax.lax.map(lambda other: shifts(query, other), database), queries)


def rotation_and_scale(query: Spectra, other: Spectra) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the rotation that aligns the query, in radians, and the size of the query relative to the other image."""
    surface = _phase_correlation(query.log_polar, other.log_polar)
    angle_steps, radius_steps = _offset_of_peak(surface, (RINGS // 2, COLUMNS // 2))
    angle, scale = jnp.pi * angle_steps / RINGS, LOG_BASE**radius_steps
    is_inverse = scale > LARGEST_SCALE
    return jnp.where(is_inverse, -angle, angle), jnp.where(is_inverse, 1 / scale, scale)


def _phase_correlation(a: Complex[Array, "80 181"], b: Complex[Array, "80 181"]) -> Float[Array, "80 360"]:
    """Return the phase correlation of two spectra. The offset of its peak from the corner is the shift from b to a."""
    cross = a * jnp.conj(b)
    amplitude = jnp.abs(cross)
    return jnp.fft.irfft2(cross * amplitude / (amplitude**2 + SMALL), (RINGS, COLUMNS))


def _offset_of_peak(surface: Float[Array, "80 360"], roll: tuple[int, int]) -> Float[Array, "2"]:
    """Return the offset (rows, columns) of a rolled surface's middle from the centre of mass around its maximum."""
    shape = np.array(surface.shape)
    # The index of the first maximum, in an eighth of the time of `jnp.argmax` on a CPU.
    index = jnp.where(surface.ravel() == surface.max(), jnp.arange(surface.size), surface.size).min()
    maximum = jnp.stack(jnp.divmod(index, COLUMNS))
    rolled_maximum = (maximum + np.array(roll)) % shape
    steps = np.arange(-PEAK_CELLS, PEAK_CELLS + 1)
    row, column = (maximum[:, None] + steps[None]) % shape[:, None]
    rolled_cells = rolled_maximum[:, None] + steps[None]  # of these, only those within the rolled surface count
    row_is_inside, column_is_inside = (rolled_cells >= 0) & (rolled_cells < shape[:, None])
    window = jnp.where(row_is_inside[:, None] & column_is_inside[None], surface[row[:, None], column[None]], 0.0)
    total = window.sum()
    moments = jnp.stack([window.sum(axis=1) @ steps, window.sum(axis=0) @ steps])
    centre_of_mass = moments / jnp.where(total == 0, 1.0, total)  # relative to the maximum
    return jnp.asarray(shape // 2) - rolled_maximum - centre_of_mass


def _rotate_and_scale(
    image: Float[Array, "80 360"], angle: Float[Array, ""], scale: Float[Array, ""]
) -> Float[Array, "80 360"]:
    """Return the image, rotated about its middle by `angle` and shrunk by `scale`, with zeros outside."""
    y, x = np.mgrid[-RINGS // 2 : RINGS // 2, -COLUMNS // 2 : COLUMNS // 2]
    cos, sin = scale * jnp.cos(angle), scale * jnp.sin(angle)
    pixels = [RINGS // 2 + sin * x + cos * y, COLUMNS // 2 + cos * x - sin * y]
    return map_coordinates(image, pixels, order=1)
