"""Exhaustive search of the pose between two images: all rotations and shifts, on merged cells.

The square root of the query's image is rotated, band-passed and correlated with the square root of the match's image.
The band-pass is the difference of a narrow and a wide blur. The band-pass keeps structures as wide as a wall, a pole or
a trunk. Without the band-pass, one street looks like any other. The correlation is needed at small shifts only, so the
inverse Fourier transform is a product with small matrices, which is faster than a full transform.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Float32, Int, Num
from scipy.fft import next_fast_len

from sglpr_jax.bev import centre_crop, rotate_image
from sglpr_jax.loops.config import VerificationConfig

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
    """Correlation at the pose: 1 for equal images, about 0 for unrelated ones."""
    second: Float[AnyArray, "*b"]
    """Highest correlation at any other pose (`second_m`, `second_deg`)."""
    ridge: Float[AnyArray, "*b"]
    """Highest correlation at `second_m` to `ridge_m` from the best pose, at about the same rotation. It is high if the
    surroundings do not show how far the sensor moved, as between walls."""

    def one(self, k: int) -> "Peak":
        """The k-th peak."""
        return Peak(*(values[k] for values in self))

    def some(self, rows: slice | np.ndarray) -> "Peak":
        """A selection of the peaks."""
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
      query: Square image of counts in the orientation of eq. 1, with an even number of cells per side.
      matches: Images of the same size.
      priors: Expected x, y (metres) and yaw (radians) of the query for each match. The pose is searched near it. A row
        of NaN means no expected pose.
      config: Settings of the comparison.

    Returns:
      Peaks with a leading axis of k.

    Raises:
      ValueError: If the images are not square or have an odd number of cells.
    """
    return search_spectra(query_spectra(query, config=config), matches, priors, config=config)


@functools.partial(jax.jit, static_argnames="config")
def query_spectra(
    query: Num[Array | np.ndarray, "h w"], *, config: VerificationConfig = DEFAULT
) -> Complex[Array, "s t f"]:
    """Return the spectra of all rotations of a query, for `search_spectra`. Raises the errors of `search`."""
    angles = np.arange(config.turns, dtype=np.float32) * np.float32(2 * np.pi / config.turns)
    rotated = rotations(merged(prepared(query, config), config.coarse), jnp.asarray(angles))
    return jnp.moveaxis(spectrum(rotated, config.resolution_m * config.coarse, config), 1, 0)


@functools.partial(jax.jit, static_argnames="config")
def search_spectra(
    spectra: Complex[Array, "s t f"],
    matches: Num[Array | np.ndarray, "k h w"],
    priors: Float[Array | np.ndarray, "k 3"] | None = None,
    *,
    config: VerificationConfig = DEFAULT,
) -> Peak:
    """Like `search`, with the `query_spectra` of a query."""
    cell_m = config.resolution_m * config.coarse
    halves = _halves(spectra)

    def one(match: tuple[Num[Array, "h w"], Float[Array, " 3"]]) -> Peak:
        image, prior = match
        there = spectrum(merged(prepared(image, config), config.coarse)[None], cell_m, config)
        return _peak(_correlations(halves, there[0], cell_m, config), prior, cell_m, config)

    priors = np.full((len(matches), 3), np.nan, np.float32) if priors is None else priors
    return jax.lax.map(one, (jnp.asarray(matches), jnp.asarray(priors, jnp.float32)))


def within_reach(image: Num[AnyArray, "h w"], config: VerificationConfig = DEFAULT) -> Num[AnyArray, "m m"]:
    """Central part of an image that is compared. m is a multiple of two merged cells. Raises the errors of `search`."""
    if image.shape[0] != image.shape[1] or image.shape[0] % 2:
        raise ValueError(f"expected a square image of an even number of cells, found {image.shape}")
    size = min(2 * cells(config.reach_m, config.resolution_m), image.shape[0])
    size = max(size - size % (2 * config.coarse), 2 * config.coarse)
    return centre_crop(image, height=size, width=size)


def prepared(image: Num[Array | np.ndarray, "h w"], config: VerificationConfig) -> Float[Array, "m m"]:
    """Square root of the counts within reach. Other cells are zero."""
    middle = within_reach(image, config)
    size = middle.shape[0]
    axis = (np.arange(size) - (size - 1) / 2) * config.resolution_m
    inside = np.hypot(axis[:, None], axis[None]) < min(config.reach_m, size / 2 * config.resolution_m)
    return jnp.where(inside, jnp.sqrt(jnp.maximum(jnp.asarray(middle, jnp.float32), 0)), 0)


def occupied(image: Num[np.ndarray, "h w"], config: VerificationConfig = DEFAULT) -> float:
    """Number of occupied cells within reach."""
    return float(np.count_nonzero(image[_within(image.shape, config.reach_m / config.resolution_m)]))


@functools.cache
def _within(shape: tuple[int, int], radius: float) -> Bool[np.ndarray, "h w"]:
    """Whether each cell lies within a radius (in cells) of the centre."""
    down, right = (np.arange(n) - (n - 1) / 2 for n in shape)
    return np.hypot(down[:, None], right[None]) < radius


def cells(metres: float, cell_m: float) -> int:
    """Number of cells that cover a length, both in metres."""
    return int(np.ceil(metres / cell_m))


def merged(image: Float[Array, "m m"], side: int) -> Float[Array, "k k"]:
    """Average pooling over squares of `side` cells."""
    size = image.shape[0] // side
    return image.reshape(size, side, size, side).mean((1, 3))


def rotations(image: Float[Array, "m m"], angles: Float[Array, " t"]) -> Float[Array, "t m m"]:
    """Rotate an image by each angle, in radians."""
    return rotate_image(jnp.broadcast_to(image, (len(angles), *image.shape)), angles)


def spectrum(images: Float[Array, "t m m"], cell_m: float, config: VerificationConfig) -> Complex[Array, "t s f"]:
    """Band-passed Fourier transforms of unit power, padded so that no shift up to `max_shift_m` wraps around."""
    size = fast_size(images.shape[-1] + cells(config.max_shift_m, cell_m))
    along, across = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    frequency = 2 * (np.pi / cell_m) ** 2 * (along**2 + across**2)
    band = np.exp(-frequency * config.blur_m**2) - np.exp(-frequency * config.wide_blur_m**2)
    filtered = jnp.fft.rfft2(images, (size, size)) * band[None].astype(np.float32)
    power = jnp.sum(jnp.abs(filtered) ** 2 * twice(size)[None], axis=(-2, -1), keepdims=True) / size**2
    return filtered / jnp.sqrt(jnp.maximum(power, 1e-9))


def fast_size(least: int) -> int:
    """Smallest size of at least `least` whose Fourier transform is fast."""
    size: Any = next_fast_len(least, real=True)  # typed as None
    return int(size)


def twice(size: int) -> Float32[np.ndarray, "1 f"]:
    """Number of times that each column of the half spectrum of a real image occurs in the full spectrum."""
    return np.where(np.isin(np.arange(size // 2 + 1), (0, size / 2)), 1, 2).astype(np.float32)[None]


class _Halves(NamedTuple):
    """Real and imaginary parts of spectra: rows of frequencies 0 to s/2, and rows of frequencies -1, -2 and so on."""

    low: tuple[Float[Array, "h t f"], Float[Array, "h t f"]]
    high: tuple[Float[Array, "g t f"], Float[Array, "g t f"]]


def _halves(spectra: Complex[Array, "s t f"]) -> _Halves:
    size = len(spectra)
    low, high = spectra[: size // 2 + 1], spectra[::-1][: (size - 1) // 2]
    return _Halves((low.real, low.imag), (high.real, high.imag))


def _correlations(
    queries: _Halves, match: Complex[Array, "s f"], cell_m: float, config: VerificationConfig
) -> Float[Array, "d t r"]:
    """Correlation of the match with every rotated query at every shift: rows down, rotations, columns to the right.

    Even and odd parts are transformed separately, for shifts of zero and more. At the opposite shift the cosine is the
    same and the sine changes its sign. This takes a quarter of the multiplications of the full transform.
    """
    size, (_, turns, width) = len(match), queries.low[0].shape
    waves = map(jnp.asarray, _waves_to(cells(config.max_shift_m, cell_m), size))
    cos_down, sin_down, cos_right, sin_right = waves
    there = _halves(match[:, None])
    low, high = _products(there.low, queries.low), _products(there.high, queries.high)
    unpaired = ((1, len(low[0]) - len(high[0]) - 1), (0, 0), (0, 0))
    even = [one + jnp.pad(other, unpaired) for one, other in zip(low, high, strict=True)]
    odd = [one[1 : len(other) + 1] - other for one, other in zip(low, high, strict=True)]
    cos_real, cos_imaginary = (cos_down @ part.reshape(len(part), -1) for part in even)
    sin_real, sin_imaginary = (sin_down @ part.reshape(len(part), -1) for part in odd)
    real = _both_ways(cos_real, sin_imaginary, axis=0).reshape(-1, width)
    imaginary = _both_ways(cos_imaginary, -sin_real, axis=0).reshape(-1, width)
    found = _both_ways(real @ cos_right, imaginary @ sin_right, axis=1)
    return found.reshape(-1, turns, found.shape[1])


def _products(
    match: tuple[Float[Array, "h 1 f"], Float[Array, "h 1 f"]],
    queries: tuple[Float[Array, "h t f"], Float[Array, "h t f"]],
) -> tuple[Float[Array, "h t f"], Float[Array, "h t f"]]:
    """Real and imaginary parts of a match's spectrum times the complex conjugates of the queries' spectra."""
    (a, b), (c, d) = match, queries
    return a * c + b * d, b * c - a * d


def _both_ways(even: Float[Array, "a b"], odd: Float[Array, "a b"], *, axis: int) -> Float[Array, "*c"]:
    """Values at all shifts in ascending order: even + odd at negative shifts, even - odd at the others."""
    before = jnp.flip(jax.lax.slice_in_dim(even + odd, 1, None, axis=axis), axis)
    return jnp.concatenate([before, even - odd], axis)


@functools.cache
def _waves_to(reach: int, size: int) -> tuple[Float32[np.ndarray, "_ _"], ...]:
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


def _peak(found: Float[Array, "d t r"], prior: Float[Array, " 3"], cell_m: float, config: VerificationConfig) -> Peak:
    reach, step = cells(config.max_shift_m, cell_m), np.float32(2 * np.pi / config.turns)
    x, y, yaw = prior  # NaN allows all poses
    expected = reach - y / cell_m, yaw / step, reach + x / cell_m
    near_prior = _near(found.shape, expected, config.prior_m / cell_m, config.prior_deg)
    highest = found.max(0)  # a maximum along the slowest axis is fast
    allowed = jnp.where(jnp.isnan(x), highest, jnp.where(near_prior, found, -1.0).max(0))
    turn, right = jnp.unravel_index(jnp.argmax(allowed), allowed.shape)
    column = found[:, turn, right]
    down = jnp.argmax(jnp.where(near_prior[:, turn, right] | jnp.isnan(x), column, -1.0))
    second, ridge = _others(found, highest, (down, turn, right), cell_m, config)
    at = down, turn, right
    down, turn, right = (index + offset for index, offset in zip(at, _offsets(found, at), strict=True))
    x, y, yaw = (right - reach) * cell_m, (reach - down) * cell_m, jnp.mod(turn * step, 2 * np.pi)
    return Peak(x, y, yaw, found[at], second, ridge)


def _others(
    found: Float[Array, "d t r"],
    highest: Float[Array, "t r"],
    at: tuple[Int[Array, ""], ...],
    cell_m: float,
    config: VerificationConfig,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Highest correlation away from a peak, and on its ridge. `highest` is the maximum over all shifts down."""
    down, turn, right = at
    most_turns = int(config.second_deg * config.turns / 360 + 1e-6)
    turns = jnp.mod(turn + np.arange(-most_turns, most_turns + 1), config.turns)
    about = found[:, turns]
    middle = down, most_turns, right
    near, on_ridge = (
        _near(about.shape, middle, metres / cell_m, 360.0) for metres in (config.second_m, config.ridge_m)
    )
    other_turns = jnp.ones(config.turns, bool).at[turns].set(False)
    ridge = jnp.max(jnp.where(on_ridge & ~near, about, 0.0))
    second = jnp.maximum(jnp.max(jnp.where(other_turns[:, None], highest, 0.0)), jnp.max(jnp.where(~near, about, 0.0)))
    return second, ridge


def _offsets(found: Float[Array, "d t r"], peak: tuple[Int[Array, ""], ...]) -> list[Float[Array, ""]]:
    """Offset of the peak from its cell along each axis, from a parabola through three values."""
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
    shape: tuple[int, ...], pose: Sequence[Float[Array, ""] | Int[Array, ""] | int], most_cells: float, most_deg: float
) -> Bool[Array, "d t r"]:
    """Whether each pose is near a given pose."""
    down, turn, right = (jnp.abs(jnp.arange(n) - at) for n, at in zip(shape, pose, strict=True))
    turn = jnp.mod(turn, shape[1])
    turn = jnp.minimum(turn, shape[1] - turn) * (360 / shape[1]) <= most_deg
    down, right = (apart <= most_cells + 1e-6 for apart in (down, right))
    return down[:, None, None] & turn[None, :, None] & right[None, None, :]
