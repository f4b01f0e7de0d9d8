"""Registration of two images, and its covariance from the shape of the peak: small at a corner, long along a wall.

The covariance sums least squares at the peak, the extent of the ridge under it, and small fixed errors. The constants
were fitted on simulated drives (`benchmarks/quality/poses.py`).
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, Num

from sglpr_jax.grid import DENSITY_RESOLUTION_M
from sglpr_jax.registration.bev_search import CorrelationPeak, search
from sglpr_jax.registration.bev_spectra import (
    DEFAULT,
    AnyArray,
    column_counts,
    match_spectra,
    prepare_image,
    query_spectra,
    rotate,
    spectrum,
)
from sglpr_jax.registration.config import VerificationConfig
from sglpr_jax.se3 import wrap_angle

NOISE, NOISE_CELLS, NOISE_RANGE_M = 0.8, 300.0, 10.0
"""Noise of the correlation: `NOISE` (1 - c) / c for a peak of height c, times 1 / occupied cells + 1 / `NOISE_CELLS`.
The second term accounts for correlated errors of neighbouring cells. The noise doubles for scans `NOISE_RANGE_M` apart,
because each scan sees other sides of objects."""
FLAT_M = 10.0
"""Standard deviation along a direction without curvature, in metres. The search covers no more."""
RIDGE_DROP = 0.04
"""Scale of the likelihood along the weak axis. The likelihood falls by a factor of e where the correlation, divided by
the area that both images share, falls by this fraction of the peak."""
RIDGE_STEP_M, RIDGE_START_M = 1.0, 1.5
"""Spacing of samples along the weak axis, and distance up to which the curvature alone counts, in metres."""
RIDGE_BAND = 0.25
"""Highest frequency of these samples, in cycles per cell. Higher frequencies take time and change nothing."""
RIDGE_ACROSS, RIDGE_YAW = 0.02, 0.003
"""Standard deviations across the weak axis (metres) and in yaw (radians), per metre along it."""
LEAST_POSITION_M, LEAST_YAW_DEG = 0.01, 0.03
"""Fixed standard deviations from the cell size and the tilt of the vehicle, in metres and degrees."""


def _peak_covariance(
    curvature: Float[Array, "3 3"],
    correlation: Float[Array, ""],
    *,
    occupied: Int[Array, ""],
    apart_m: Float[Array, ""],
    ridge: Float[Array, "3 3"],
) -> Float[Array, "3 3"]:
    """Covariance of (x, y, yaw) at a peak, from the negative Hessian and the height of the correlation there.

    `occupied` is the number of cells of the image that has fewer.
    """
    height = jnp.clip(correlation, 0.05, 0.999)
    noise = NOISE * (1 - height) / height * (1 / jnp.maximum(occupied, 1) + 1 / NOISE_CELLS)
    noise = noise * (1 + (apart_m / NOISE_RANGE_M) ** 2)
    strengths, directions = jnp.linalg.eigh(curvature)
    spread = noise / (jnp.maximum(strengths, 0) + noise / FLAT_M**2)
    peak = (directions * spread[None]) @ directions.T
    across_ridge = jnp.trace(ridge[:2, :2]) * np.array([RIDGE_ACROSS, RIDGE_ACROSS, RIDGE_YAW], np.float32) ** 2
    least = np.array([LEAST_POSITION_M, LEAST_POSITION_M, np.radians(LEAST_YAW_DEG)], np.float32) ** 2
    return peak + ridge + jnp.diag(across_ridge + least)


def _ridge_covariance(
    products: Complex[Array, "t s f"],
    pose: Float[Array, " 3"],
    yaws: Float[Array, " t"],
    curvature: Float[Array, "3 3"],
    config: VerificationConfig,
) -> Float[Array, "3 3"]:
    """Covariance of (x, y, yaw) along the weak axis of a peak, as far as the correlation stays high there.

    Along a wall the correlation falls only because the two images share less area. In a bend the ridge rotates with the
    distance, so the best of several rotations counts. Samples beyond a minimum belong to another peak and count no more
    than the minimum.

    Arguments:
      products: Fourier transforms (`rfft2`) of the correlation at each rotation of `yaws`.
      pose: x, y (metres) and yaw (radians) of the peak.
      yaws: Rotations in radians, that of the peak first.
      curvature: Negative Hessian of the correlation at the peak.
      config: Settings of the comparison.
    """
    steps = int(config.max_shift_m / RIDGE_STEP_M)
    along_m = np.arange(-steps, steps + 1, dtype=np.float32) * np.float32(RIDGE_STEP_M)
    turns = jnp.asarray(yaws - pose[2]).at[0].set(0.0)
    yaw_part = curvature[:2, 2:] * curvature[2:, :2] / jnp.maximum(curvature[2, 2], 1e-4)
    planar = curvature[:2, :2] - yaw_part  # curvature in x and y at the best yaw of each position
    weak_axis = jnp.arctan2(2 * planar[0, 1], planar[0, 0] - planar[1, 1]) / 2 + np.float32(np.pi / 2)
    heading = weak_axis + turns / 2  # the chord of an arc
    shifts = along_m[None, :, None] * jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=1)[:, None]
    points = pose[None, None, :2] + shifts
    area = _shared_area(jnp.hypot(points[..., 0], points[..., 1]), config.reach_m)
    heights = jax.vmap(functools.partial(_heights, cell_m=DENSITY_RESOLUTION_M))(products, points) / area
    share = heights.max(0) / jnp.maximum(heights[0, steps], 1e-6)
    share = jnp.concatenate([jax.lax.cummin(share[steps::-1])[::-1], jax.lax.cummin(share[steps:])[1:]])
    best = heights.argmax(0)
    apart = jnp.concatenate([shifts[best, np.arange(len(along_m))], turns[best][:, None]], axis=1)
    inside = (jnp.abs(points[0]).max(1) <= config.max_shift_m + RIDGE_STEP_M) | (along_m == 0)
    weight = jnp.where(inside, jnp.exp(-jnp.maximum(1 - share, 0) / RIDGE_DROP), 0)
    outside = (np.abs(along_m) >= RIDGE_START_M).astype(np.float32)
    return jnp.einsum("k,ki,kj->ij", weight * outside, apart, apart) / weight.sum()


def _heights(product: Complex[Array, "s f"], points: Float[Array, "k 2"], cell_m: float) -> Float[Array, " k"]:
    """Low frequencies of a correlation at points (x, y) in metres, up to a common factor."""
    size = product.shape[0]
    band = int(RIDGE_BAND * size)
    low = jnp.concatenate([product[-band:, :band], product[:band, :band]])
    phases = points * np.float32(2 * np.pi / (cell_m * size))
    rows = jnp.exp(-1j * phases[:, 1:] * np.arange(-band, band, dtype=np.float32)[None])
    columns = jnp.exp(1j * phases[:, :1] * np.arange(band, dtype=np.float32)[None])
    counts = np.where(np.arange(band) == 0, 1, 2).astype(np.float32)  # half of a real image's spectrum is stored
    return ((rows @ low) * columns).real @ counts


def _shared_area(apart_m: Float[Array, "*b"], reach_m: float) -> Float[Array, "*b"]:
    """Fraction of a circle of radius `reach_m` that overlaps with an equal circle at this distance."""
    ratio = jnp.minimum(apart_m / (2 * reach_m), 0.95)
    return (jnp.arccos(ratio) - ratio * jnp.sqrt(1 - ratio**2)) * np.float32(2 / np.pi)


class BevRegistration(NamedTuple):
    """Pose of a query in the frame of a match, in the plane, with covariance and correlation."""

    x: Float[AnyArray, "*b"]
    y: Float[AnyArray, "*b"]
    """Position of the query's sensor in the match's frame, in metres."""
    yaw: Float[AnyArray, "*b"]
    """Rotation of the query in the match's frame, in radians, counter-clockwise, from -pi to pi."""
    covariance: Float[AnyArray, "*b 3 3"]
    """Covariance of x, y (metres) and yaw (radians), in the match's frame.

    It follows the shape of the peak. That another peak may be the correct one does not count; see `second`.
    """
    correlation: Float[AnyArray, "*b"]
    """Correlation at the peak: 1 for equal images, about 0 for unrelated ones."""
    second: Float[AnyArray, "*b"]
    """Second-peak ratio: height of the second peak divided by the first. It is near 1 if another pose fits as well."""

    @property
    def along_m(self) -> float:
        """Standard deviation of the position of one alignment along its least certain direction, in metres."""
        return float(np.sqrt(np.linalg.eigvalsh(np.asarray(self.covariance)[:2, :2])[1]))

    def angle_to(self, yaw: float) -> float:
        """Angle between the rotation and another one, in radians, from 0 to pi. NaN if the other one is unknown."""
        return float(abs(wrap_angle(np.asarray(float(self.yaw) - float(yaw)))))


REFINE_DEG = 3.0
"""Range of the refinement to each side, in degrees, in `TURN_STEPS` steps."""
TURN_STEPS = 4
"""Number of rotation steps of the refinement to each side."""
RIDGE_TURNS = (0, 2, 6, 8)
"""Indices of these rotations at which a bent ridge is searched."""
SHIFT_STEPS = 5
"""Number of steps of half a cell of the refinement to each side, in x and y."""


@functools.partial(jax.jit, static_argnames="config")
def align(
    query: Num[Array | np.ndarray, "h w"],
    match: Num[Array | np.ndarray, "h w"],
    *,
    config: VerificationConfig = DEFAULT,
) -> BevRegistration:
    """Estimate the pose of a query in the frame of a match from their images, also under `jit` and `vmap`.

    Both are square images of counts in the orientation of eq. 1, with an even number of cells per side. Raises
    ValueError for other images.
    """
    spectra = query_spectra(query, config=config), match_spectra(jnp.asarray(match)[None], config=config)
    return refine(query, match, search(*spectra, config=config).at(0), config=config)


@functools.partial(jax.jit, static_argnames="config")
def refine(
    query: Num[Array | np.ndarray, "h w"],
    match: Num[Array | np.ndarray, "h w"],
    peak: CorrelationPeak,
    *,
    config: VerificationConfig = DEFAULT,
) -> BevRegistration:
    """Register two images from a peak of `search`, on cells that are not merged. Raises the errors of `align`."""
    second = jnp.where(peak.correlation > 1e-3, peak.second / jnp.maximum(peak.correlation, 1e-6), 1.0)
    query, match = prepare_image(query, config), prepare_image(match, config)
    pose, correlation, covariance = _refine_peak(query, match, jnp.stack([peak.x, peak.y, peak.yaw]), config)
    yaw = jnp.mod(pose[2] + jnp.pi, 2 * jnp.pi) - jnp.pi
    return BevRegistration(pose[0], pose[1], yaw, covariance, correlation, second)


def _refine_peak(
    query: Float[Array, "m m"], match: Float[Array, "m m"], start: Float[Array, " 3"], config: VerificationConfig
) -> tuple[Float[Array, " 3"], Float[Array, ""], Float[Array, "3 3"]]:
    """Peak near the pose `start`: (x, y, yaw), its correlation, and the covariance of the pose."""
    cell_m, step_rad = DENSITY_RESOLUTION_M, np.float32(np.radians(REFINE_DEG) / TURN_STEPS)
    yaws = start[2] + jnp.arange(-TURN_STEPS, TURN_STEPS + 1) * step_rad
    product = spectrum(match[None], cell_m, config) * jnp.conj(spectrum(rotate(query, yaws), cell_m, config))
    size = product.shape[1]
    steps = np.arange(-SHIFT_STEPS, SHIFT_STEPS + 1, dtype=np.float32) * (cell_m / 2)
    xs, ys = start[0] + steps, start[1] + steps
    rows = _waves(-ys / cell_m, np.fft.fftfreq(size))
    columns = _waves(xs / cell_m, np.fft.rfftfreq(size)) * column_counts(size)
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
    ridge = _ridge_covariance(product[turns], pose, yaws[turns], curvature, config)
    covariance = _peak_covariance(
        curvature,
        correlation,
        occupied=jnp.minimum((query > 0).sum(), (match > 0).sum()),
        apart_m=jnp.hypot(pose[0], pose[1]),
        ridge=ridge,
    )
    return pose, correlation, covariance


def _waves(shifts: Float[Array, " k"], frequencies: Float[np.ndarray, " f"]) -> Complex[Array, "k f"]:
    """Factors of a Fourier series at shifts between cells."""
    return jnp.exp(2j * np.pi * shifts[:, None] * jnp.asarray(frequencies, jnp.float32)[None])


def _parabola(block: Float[Array, "3 3 3"]) -> tuple[Float[Array, ""], Float[Array, " 3"], Float[Array, "3 3"]]:
    """Value, gradient and Hessian at the centre of the least-squares parabola through 27 values."""
    offsets = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), -1).reshape(27, 3)
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    columns = [np.ones(27), *offsets.T, *(offsets[:, i] * offsets[:, j] for i, j in pairs)]
    fitted = jnp.asarray(np.linalg.pinv(np.stack(columns, 1)), jnp.float32) @ block.reshape(27)
    half = jnp.zeros((3, 3)).at[tuple(np.array(pairs).T)].set(fitted[4:])
    return fitted[0], fitted[1:4], half + half.T
