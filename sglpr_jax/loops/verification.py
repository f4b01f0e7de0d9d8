"""Are two scans of one place, and how do they lie? The correlation of their images seen from above, over all turns.

The square root of the query's image is turned, filtered and shifted over the match's; where the two agree best is the
pose. First on cells merged by `coarse`, over the whole circle; then about the best peak on whole cells, where a Fourier
series tells what lies between cells, and a parabola between turns. The filter leaves what is as wide as a wall, a pole
or a trunk: a blur, less a wider blur, without which one street looks like any other.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int, Num
from scipy.fft import next_fast_len

from sglpr_jax.bev import centre_crop, rotate_image
from sglpr_jax.data.density_grid import RESOLUTION_M
from sglpr_jax.loops.peak_covariance import peak_covariance, ridge_covariance


@dataclasses.dataclass(frozen=True)
class VerificationConfig:
    """How two images are laid over each other."""

    resolution_m: float = RESOLUTION_M
    """The edge of an image's cell."""
    reach_m: float = 25.0
    """Cells farther from the sensor do not count, so that an image looks alike however it is turned."""
    max_shift_m: float = 12.0
    """Scans of one place are no farther apart, along x or y."""
    turns: int = 72
    """Turns that the first search tries, over the whole circle."""
    coarse: int = 2
    """So many cells a side are one in the first search."""
    blur_m: float = 0.4
    wide_blur_m: float = 1.0
    """Standard deviations of the two blurs, the second of which is taken away."""
    refine_deg: float = 3.0
    """The second search turns so far to both sides, in 8 steps."""
    second_m: float = 3.0
    second_deg: float = 15.0
    """A second peak is farther than this from the best one, in metres or in degrees."""


class Alignment(NamedTuple):
    """How a query lies in the frame of a match: the pose `match_from_query` in the plane, and how sure it is."""

    x: Float[Array, "*b"]
    y: Float[Array, "*b"]
    """Where the query's sensor is in the match's frame, metres."""
    yaw: Float[Array, "*b"]
    """How it is turned there, radians, counter-clockwise, from -pi to pi."""
    covariance: Float[Array, "*b 3 3"]
    """Covariance of x, y (metres) and yaw (radians), in the match's frame.

    It follows the shape of the peak: metres along a plain wall, centimetres across. It does not include the chance that
    another peak is the right one; see `second`.
    """
    correlation: Float[Array, "*b"]
    """At the peak: 1 for equal images, about 0 for images that have nothing to do with each other."""
    second: Float[Array, "*b"]
    """The height of the second peak as a share of the first: near 1 where another pose fits as well."""

    def one(self, k: int) -> "Alignment":
        """The k-th of several."""
        return Alignment(*(value[k] for value in self))


DEFAULT = VerificationConfig()
TURN_STEPS = 4
"""Steps of the second search to each side in angle."""
RIDGE_TURNS = (0, 2, 6, 8)
"""Those of these angles at which a ridge that bends is looked for."""
SHIFT_STEPS = 5
"""Steps of half a cell of the second search to each side in x and y."""


@functools.partial(jax.jit, static_argnames="config")
def align(
    query: Num[Array | np.ndarray, "h w"],
    match: Num[Array | np.ndarray, "h w"],
    *,
    config: VerificationConfig = DEFAULT,
) -> Alignment:
    """Lay the image of a query over that of a match, both (n, n) counts in the orientation of eq. 1, n even.

    Works under jit and vmap; of one query with several matches (`align_all`) the query is turned once. Raises
    ValueError for images that are not square or have an odd number of cells.
    """
    query, match = _prepared(query, config), _prepared(match, config)
    start, second = _whole_circle(_merged(query, config.coarse), _merged(match, config.coarse), config)
    pose, correlation, covariance = _refined(query, match, start, config)
    yaw = jnp.mod(pose[2] + jnp.pi, 2 * jnp.pi) - jnp.pi
    return Alignment(pose[0], pose[1], yaw, covariance, correlation, second)


@functools.partial(jax.jit, static_argnames="config")
def align_all(
    query: Num[Array | np.ndarray, "h w"],
    matches: Num[Array | np.ndarray, "k h w"],
    *,
    config: VerificationConfig = DEFAULT,
) -> Alignment:
    """`align` one query with each of several matches; every field has a leading axis of k."""
    return jax.vmap(lambda match: align(query, match, config=config))(jnp.asarray(matches))


def _prepared(image: Num[Array | np.ndarray, "h w"], config: VerificationConfig) -> Float[Array, "m m"]:
    """The square root of the counts within reach, zero around them; m is a multiple of two merged cells."""
    if image.shape[0] != image.shape[1] or image.shape[0] % 2:
        raise ValueError(f"expected a square image of an even number of cells, found {image.shape}")
    size = min(2 * _cells(config.reach_m, config.resolution_m), image.shape[0])
    size = max(size - size % (2 * config.coarse), 2 * config.coarse)
    axis = (np.arange(size) - (size - 1) / 2) * config.resolution_m
    inside = np.hypot(axis[:, None], axis[None]) < min(config.reach_m, size / 2 * config.resolution_m)
    counts = centre_crop(jnp.asarray(image, jnp.float32), height=size, width=size)
    return jnp.where(inside, jnp.sqrt(jnp.maximum(counts, 0)), 0)


def _cells(metres: float, cell_m: float) -> int:
    return int(np.ceil(metres / cell_m))


def _merged(image: Float[Array, "m m"], cells: int) -> Float[Array, "k k"]:
    size = image.shape[0] // cells
    return image.reshape(size, cells, size, cells).mean((1, 3))


def _whole_circle(
    query: Float[Array, "m m"], match: Float[Array, "m m"], config: VerificationConfig
) -> tuple[Float[Array, " 3"], Float[Array, ""]]:
    """The best of all turns and shifts, as (x, y, yaw), and the second peak as a share of the best."""
    cell_m = config.resolution_m * config.coarse
    reach = _cells(config.max_shift_m, cell_m)
    angles = np.arange(config.turns, dtype=np.float32) * np.float32(2 * np.pi / config.turns)
    product, size = _product(_turned(query, jnp.asarray(angles)), match, cell_m, config)
    shifts = jnp.roll(jnp.fft.irfft2(product, (size, size)), (reach, reach), (-2, -1))
    found = shifts[:, : 2 * reach + 1, : 2 * reach + 1]
    turn, down, right = jnp.unravel_index(jnp.argmax(found), found.shape)
    best = found[turn, down, right]
    elsewhere = jnp.where(_near(found.shape, (turn, down, right), cell_m, config), 0.0, found)
    start = jnp.stack([(right - reach) * cell_m, (reach - down) * cell_m, jnp.asarray(angles)[turn]])
    second = jnp.maximum(jnp.max(elsewhere), 0) / jnp.maximum(best, 1e-6)
    return start, jnp.where(best > 1e-3, second, 1.0)  # where nothing fits, any pose fits as well


def _turned(image: Float[Array, "m m"], angles: Float[Array, " t"]) -> Float[Array, "t m m"]:
    return rotate_image(jnp.broadcast_to(image, (len(angles), *image.shape)), angles)


def _product(
    queries: Float[Array, "t m m"], match: Float[Array, "m m"], cell_m: float, config: VerificationConfig
) -> tuple[Complex[Array, "t s f"], int]:
    """The Fourier transform of the correlation of each query with the match, and s, the size of that.

    It is so large that no shift up to the greatest one wraps around.
    """
    size = _fast_size(match.shape[0] + _cells(config.max_shift_m, cell_m))
    along, across = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    frequency = 2 * (np.pi / cell_m) ** 2 * (along**2 + across**2)
    band = np.exp(-frequency * config.blur_m**2) - np.exp(-frequency * config.wide_blur_m**2)

    def spectrum(images: Float[Array, "t m m"]) -> Complex[Array, "t s f"]:
        filtered = jnp.fft.rfft2(images, (size, size)) * band[None].astype(np.float32)
        power = jnp.sum(jnp.abs(filtered) ** 2 * _twice(size)[None], axis=(-2, -1), keepdims=True) / size**2
        return filtered / jnp.sqrt(jnp.maximum(power, 1e-9))

    return spectrum(match[None]) * jnp.conj(spectrum(queries)), size


def _fast_size(least: int) -> int:
    """A size, no smaller, of which Fourier transforms are fast."""
    size: Any = next_fast_len(least, real=True)  # whose types say None
    return int(size)


def _twice(size: int) -> Float[np.ndarray, "1 f"]:
    """How often each column of a real image's half spectrum stands in the whole one."""
    return np.where(np.isin(np.arange(size // 2 + 1), (0, size / 2)), 1, 2).astype(np.float32)[None]


def _near(
    shape: tuple[int, ...], peak: tuple[Int[Array, ""], ...], cell_m: float, config: VerificationConfig
) -> Bool[Array, "t d r"]:
    """Which values of the first search belong to its best peak."""
    apart = [jnp.abs(jnp.arange(n) - at) for n, at in zip(shape, peak, strict=True)]
    turns = jnp.minimum(apart[0], shape[0] - apart[0]) * (360 / shape[0]) <= config.second_deg
    down, right = (cells * cell_m <= config.second_m for cells in apart[1:])
    return turns[:, None, None] & down[None, :, None] & right[None, None, :]


def _refined(
    query: Float[Array, "m m"], match: Float[Array, "m m"], start: Float[Array, " 3"], config: VerificationConfig
) -> tuple[Float[Array, " 3"], Float[Array, ""], Float[Array, "3 3"]]:
    """The peak near the pose `start`: (x, y, yaw), the correlation there, and the covariance of the pose."""
    cell_m, step_rad = config.resolution_m, np.float32(np.radians(config.refine_deg) / TURN_STEPS)
    yaws = start[2] + jnp.arange(-TURN_STEPS, TURN_STEPS + 1) * step_rad
    product, size = _product(_turned(query, yaws), match, cell_m, config)
    steps = np.arange(-SHIFT_STEPS, SHIFT_STEPS + 1, dtype=np.float32) * (cell_m / 2)
    xs, ys = start[0] + steps, start[1] + steps
    rows = _waves(-ys / cell_m, np.fft.fftfreq(size))
    columns = _waves(xs / cell_m, np.fft.rfftfreq(size)) * _twice(size)
    volume = jnp.einsum("tij,yi,xj->xyt", product, rows, columns).real / size**2
    peak = jnp.unravel_index(jnp.argmax(volume), volume.shape)
    middle = [jnp.clip(at, 1, n - 2) for at, n in zip(peak, volume.shape, strict=True)]
    value, gradient, hessian = _parabola(jax.lax.dynamic_slice(volume, [at - 1 for at in middle], (3, 3, 3)))
    offset = jnp.clip(jnp.linalg.solve(hessian - 1e-6 * jnp.eye(3), -gradient), -1, 1)
    sizes = jnp.array([cell_m / 2, cell_m / 2, step_rad])
    pose = jnp.stack([xs[middle[0]], ys[middle[1]], yaws[middle[2]]]) + offset * sizes
    correlation = value + gradient @ offset + offset @ hessian @ offset / 2
    curvature = -hessian / (sizes[:, None] * sizes[None])
    turns = jnp.concatenate([middle[2][None] + jnp.round(offset[2]).astype(int), np.array(RIDGE_TURNS)])
    ridge = ridge_covariance(
        product[turns],
        pose,
        yaws[turns],
        curvature,
        cell_m=cell_m,
        reach_m=config.reach_m,
        max_shift_m=config.max_shift_m,
    )
    covariance = peak_covariance(
        curvature,
        correlation,
        occupied=jnp.minimum((query > 0).sum(), (match > 0).sum()),
        apart_m=jnp.hypot(pose[0], pose[1]),
        ridge=ridge,
    )
    return pose, correlation, covariance


def _waves(shifts: Float[Array, " k"], frequencies: Float[np.ndarray, " f"]) -> Complex[Array, "k f"]:
    """The factors that a Fourier series takes at shifts between the cells."""
    return jnp.exp(2j * np.pi * shifts[:, None] * jnp.asarray(frequencies, jnp.float32)[None])


def _parabola(block: Float[Array, "3 3 3"]) -> tuple[Float[Array, ""], Float[Array, " 3"], Float[Array, "3 3"]]:
    """Value, gradient and Hessian, at the middle one, of the least-squares parabola through 27 values."""
    offsets = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), -1).reshape(27, 3)
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    columns = [np.ones(27), *offsets.T, *(offsets[:, i] * offsets[:, j] for i, j in pairs)]
    fitted = jnp.asarray(np.linalg.pinv(np.stack(columns, 1)), jnp.float32) @ block.reshape(27)
    half = jnp.zeros((3, 3)).at[tuple(np.array(pairs).T)].set(fitted[4:])
    return fitted[0], fitted[1:4], half + half.T
