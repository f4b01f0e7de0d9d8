"""The pose between two images by exhaustive search: all rotations and shifts, on merged cells.

The square root of the query's image is rotated, band-passed and correlated with that of the match. The band is a blur
less a wider blur: it keeps what is as wide as a wall, a pole or a trunk, without which one street looks like any other.
The correlation is needed at small shifts alone, so the inverse Fourier transform is a product with two small matrices,
which is faster than a whole one.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Float32, Int, Num
from scipy.fft import next_fast_len

from sglpr_jax.bev import centre_crop, rotate_image
from sglpr_jax.data.density_grid import RESOLUTION_M


@dataclasses.dataclass(frozen=True)
class VerificationConfig:
    """How two images are compared."""

    resolution_m: float = RESOLUTION_M
    """Edge of an image's cell, in metres."""
    reach_m: float = 25.0
    """Cells farther from the sensor are ignored, so that an image does not change with rotation, in metres."""
    max_shift_m: float = 12.0
    """Maximum distance between two scans of one place along x and along y, in metres."""
    turns: int = 72
    """Number of rotations over the whole circle."""
    coarse: int = 2
    """Cells per side that the exhaustive search merges into one."""
    blur_m: float = 0.4
    wide_blur_m: float = 1.0
    """Standard deviations of the two blurs, in metres; the wider one is subtracted."""
    refine_deg: float = 3.0
    """Range of the refinement to both sides, in degrees, in 8 steps."""
    second_m: float = 3.0
    second_deg: float = 15.0
    """Minimum distance of the second peak from the best one, in metres or in degrees."""
    ridge_m: float = 6.0
    """Maximum distance at which a peak of the same rotation belongs to the ridge of the best one, in metres."""
    prior_m: float = 2.0
    prior_deg: float = 10.0
    """Maximum distance of a pose from the expected one, where there is one."""


DEFAULT = VerificationConfig()


AnyArray = Array | np.ndarray


class Peak(NamedTuple):
    """The best pose of a query in the frame of a match, to a fraction of a merged cell."""

    x: Float[AnyArray, "*b"]
    y: Float[AnyArray, "*b"]
    """Position of the query in the match's frame, in metres."""
    yaw: Float[AnyArray, "*b"]
    """Rotation of the query, in radians, counter-clockwise, from 0 to 2 pi."""
    correlation: Float[AnyArray, "*b"]
    """1 for equal images, about 0 for unrelated ones."""
    second: Float[AnyArray, "*b"]
    """Highest correlation at any other pose (`second_m`, `second_deg`)."""
    ridge: Float[AnyArray, "*b"]
    """Highest correlation at `second_m` to `ridge_m` from the best pose, at about its rotation: high where the
    surroundings do not tell how far the sensor moved, as between walls."""

    def one(self, k: int) -> "Peak":
        """The k-th of several."""
        return Peak(*(values[k] for values in self))

    def some(self, rows: slice) -> "Peak":
        """Some of several."""
        return Peak(*(values[rows] for values in self))


NO_PEAKS = Peak(*[np.zeros(0, np.float32)] * len(Peak._fields))


@functools.partial(jax.jit, static_argnames="config")
def search(
    query: Num[Array | np.ndarray, "h w"],
    matches: Num[Array | np.ndarray, "k h w"],
    priors: Float[Array | np.ndarray, "k 3"] | None = None,
    *,
    config: VerificationConfig = DEFAULT,
) -> Peak:
    """Return the best pose of a query in the frame of each of k matches.

    Arguments:
      query: A square image of counts in the orientation of eq. 1, with an even number of cells per side.
      matches: Images of the same size.
      priors: Expected x, y (metres) and yaw (radians) of the query for each match, near which the pose is searched; a
        row of NaN has none.
      config: The search range.

    Returns:
      Peaks with a leading axis of k.

    Raises:
      ValueError: if the images are not square or have an odd number of cells.
    """
    angles = np.arange(config.turns, dtype=np.float32) * np.float32(2 * np.pi / config.turns)
    cell_m = config.resolution_m * config.coarse
    rotated = rotations(merged(prepared(query, config), config.coarse), jnp.asarray(angles))
    spectra = jnp.moveaxis(spectrum(rotated, cell_m, config), 1, 0)

    def one(match: tuple[Num[Array, "h w"], Float[Array, " 3"]]) -> Peak:
        image, prior = match
        there = spectrum(merged(prepared(image, config), config.coarse)[None], cell_m, config)
        return _peak(_correlations(spectra, there[0], cell_m, config), prior, cell_m, config)

    priors = np.full((len(matches), 3), np.nan, np.float32) if priors is None else priors
    return jax.lax.map(one, (jnp.asarray(matches), jnp.asarray(priors, jnp.float32)))


def prepared(image: Num[Array | np.ndarray, "h w"], config: VerificationConfig) -> Float[Array, "m m"]:
    """The square root of the counts within reach, zero around them; m is a multiple of two merged cells."""
    if image.shape[0] != image.shape[1] or image.shape[0] % 2:
        raise ValueError(f"expected a square image of an even number of cells, found {image.shape}")
    size = min(2 * cells(config.reach_m, config.resolution_m), image.shape[0])
    size = max(size - size % (2 * config.coarse), 2 * config.coarse)
    axis = (np.arange(size) - (size - 1) / 2) * config.resolution_m
    inside = np.hypot(axis[:, None], axis[None]) < min(config.reach_m, size / 2 * config.resolution_m)
    counts = centre_crop(jnp.asarray(image, jnp.float32), height=size, width=size)
    return jnp.where(inside, jnp.sqrt(jnp.maximum(counts, 0)), 0)


def cells(metres: float, cell_m: float) -> int:
    """Number of cells that cover a length."""
    return int(np.ceil(metres / cell_m))


def merged(image: Float[Array, "m m"], side: int) -> Float[Array, "k k"]:
    """Means over squares of cells."""
    size = image.shape[0] // side
    return image.reshape(size, side, size, side).mean((1, 3))


def rotations(image: Float[Array, "m m"], angles: Float[Array, " t"]) -> Float[Array, "t m m"]:
    """The image rotated by each angle."""
    return rotate_image(jnp.broadcast_to(image, (len(angles), *image.shape)), angles)


def spectrum(images: Float[Array, "t m m"], cell_m: float, config: VerificationConfig) -> Complex[Array, "t s f"]:
    """Band-passed Fourier transforms, of unit power, so large that no shift up to the greatest one wraps around."""
    size = fast_size(images.shape[-1] + cells(config.max_shift_m, cell_m))
    along, across = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    frequency = 2 * (np.pi / cell_m) ** 2 * (along**2 + across**2)
    band = np.exp(-frequency * config.blur_m**2) - np.exp(-frequency * config.wide_blur_m**2)
    filtered = jnp.fft.rfft2(images, (size, size)) * band[None].astype(np.float32)
    power = jnp.sum(jnp.abs(filtered) ** 2 * twice(size)[None], axis=(-2, -1), keepdims=True) / size**2
    return filtered / jnp.sqrt(jnp.maximum(power, 1e-9))


def fast_size(least: int) -> int:
    """A size, no smaller, whose Fourier transforms are fast."""
    size: Any = next_fast_len(least, real=True)  # whose types say None
    return int(size)


def twice(size: int) -> Float32[np.ndarray, "1 f"]:
    """How often each column of a real image's half spectrum occurs in the whole one."""
    return np.where(np.isin(np.arange(size // 2 + 1), (0, size / 2)), 1, 2).astype(np.float32)[None]


def _correlations(
    queries: Complex[Array, "s t f"], match: Complex[Array, "s f"], cell_m: float, config: VerificationConfig
) -> Float[Array, "d t r"]:
    """Correlation of the match with every rotated query at every shift: rows down, rotations, columns to the right."""
    size, turns, width = queries.shape
    reach = cells(config.max_shift_m, cell_m)
    rows, columns = _inverse_transforms(size, reach)
    real, imaginary = match.real[:, None], match.imag[:, None]
    product = [
        real * queries.real + imaginary * queries.imag,
        imaginary * queries.real - real * queries.imag,
    ]
    by_row = (rows @ jnp.concatenate(product).reshape(2 * size, turns * width)).reshape(2, -1, turns, width)
    return (jnp.moveaxis(by_row, 0, 2).reshape(-1, 2 * width) @ columns).reshape(-1, turns, columns.shape[1])


@functools.cache
def _inverse_transforms(size: int, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Matrices of the inverse Fourier transform along columns and along rows, for shifts from -reach to reach.

    Complex numbers are pairs of real ones, which XLA multiplies faster.
    """
    shifts = np.arange(-reach, reach + 1)
    down = 2 * np.pi * np.outer(shifts, np.fft.fftfreq(size))
    right, often = 2 * np.pi * np.outer(np.fft.rfftfreq(size), shifts), twice(size).T / size**2
    rows = np.block([[np.cos(down), -np.sin(down)], [np.sin(down), np.cos(down)]])
    columns = np.concatenate([np.cos(right) * often, -np.sin(right) * often])
    return rows.astype(np.float32), columns.astype(np.float32)


def _peak(found: Float[Array, "d t r"], prior: Float[Array, " 3"], cell_m: float, config: VerificationConfig) -> Peak:
    reach, step = cells(config.max_shift_m, cell_m), np.float32(2 * np.pi / config.turns)
    x, y, yaw = prior  # of which NaN leaves everything
    expected = reach - y / cell_m, yaw / step, reach + x / cell_m
    near_prior = _near(found.shape, expected, config.prior_m / cell_m, config.prior_deg)
    at = jnp.unravel_index(jnp.argmax(jnp.where(near_prior | jnp.isnan(x), found, -1.0)), found.shape)
    near = _near(found.shape, at, config.second_m / cell_m, config.second_deg)
    about = _near(found.shape, at, config.ridge_m / cell_m, config.second_deg)
    second, ridge = (jnp.max(jnp.where(where, found, 0.0)) for where in (~near, about & ~near))
    down, turn, right = (index + offset for index, offset in zip(at, _offsets(found, at), strict=True))
    x, y, yaw = (right - reach) * cell_m, (reach - down) * cell_m, jnp.mod(turn * step, 2 * np.pi)
    return Peak(x, y, yaw, found[at], second, ridge)


def _offsets(found: Float[Array, "d t r"], peak: tuple[Int[Array, ""], ...]) -> list[Float[Array, ""]]:
    """Where the peak lies between the cells along each axis: that of the parabola through three values."""
    offsets = []
    for axis, at in enumerate(peak):
        size = found.shape[axis]
        before, after = at - 1, at + 1
        if axis != 1:  # rotations wrap around, shifts end
            before, after = jnp.maximum(before, 0), jnp.minimum(after, size - 1)
        low, best, high = (
            found[tuple(where if k == axis else other for k, other in enumerate(peak))]
            for where in (before % size, at, after % size)
        )
        bend = low - 2 * best + high
        offset = (low - high) / (2 * jnp.where(bend < 0, bend, -1e9))
        offsets.append(jnp.clip(offset, -0.5, 0.5))
    return offsets


def _near(
    shape: tuple[int, ...], pose: Sequence[Float[Array, ""] | Int[Array, ""]], most_cells: float, most_deg: float
) -> Bool[Array, "d t r"]:
    """Which poses are near one."""
    down, turn, right = (jnp.abs(jnp.arange(n) - at) for n, at in zip(shape, pose, strict=True))
    turn = jnp.mod(turn, shape[1])
    turn = jnp.minimum(turn, shape[1] - turn) * (360 / shape[1]) <= most_deg
    down, right = (apart <= most_cells + 1e-6 for apart in (down, right))
    return down[:, None, None] & turn[None, :, None] & right[None, None, :]
