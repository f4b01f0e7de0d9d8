"""Registration of two images, and its covariance from the shape of the correlation's peak.

The covariance is a sum: least squares at the peak, the length of the ridge of high correlation (as along a wall), and
small fixed errors. The constants were fitted on simulated drives (`benchmarks/quality/poses.py`).
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, Num

from sglpr_jax.grid import DENSITY_RESOLUTION_M
from sglpr_jax.registration.bev_config import VerificationConfig
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
from sglpr_jax.se3 import transform, wrap_angle

NOISE, NOISE_CELLS, NOISE_RANGE_M = 0.8, 300.0, 10.0
"""Noise of the correlation: `NOISE` (1 - c) / c for a peak of height c, times 1 / occupied cells + 1 / `NOISE_CELLS`.
The second term accounts for correlated errors of neighbouring cells. The noise doubles for scans `NOISE_RANGE_M` apart,
because each scan sees other sides of objects."""
FLAT_M = 10.0
"""Standard deviation along a direction without curvature, in metres. The search covers no more."""
RIDGE_DROP = 0.04
"""Scale of the likelihood along the ridge. The likelihood falls by a factor of e where the correlation, divided by the
area that both images share, falls by this fraction of the peak."""
RIDGE_STEP_M, RIDGE_START_M = 1.0, 1.5
"""Spacing of samples along the ridge, and distance from the peak below which samples do not count, in metres."""
RIDGE_BAND = 0.25
"""Highest frequency of these samples, in cycles per cell. Higher frequencies take time and change nothing."""
RIDGE_ACROSS, RIDGE_YAW = 0.02, 0.003
"""Standard deviations across the ridge (metres) and in yaw (radians), per metre along it."""
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

    `occupied` is the number of occupied cells of the image that has fewer. `apart_m` is the distance of the two scans.
    `ridge` is the result of `_ridge_covariance`.
    """
    height = jnp.clip(correlation, 0.05, 0.999)
    noise = NOISE * (1 - height) / height * (1 / jnp.maximum(occupied, 1) + 1 / NOISE_CELLS)
    noise = noise * (1 + (apart_m / NOISE_RANGE_M) ** 2)
    curvatures, directions = jnp.linalg.eigh(curvature)
    variances = noise / (jnp.maximum(curvatures, 0) + noise / FLAT_M**2)
    peak = (directions * variances[None]) @ directions.T
    ridge_m2 = jnp.trace(ridge[:2, :2])
    across_ridge = ridge_m2 * np.array([RIDGE_ACROSS, RIDGE_ACROSS, RIDGE_YAW], np.float32) ** 2
    least = np.array([LEAST_POSITION_M, LEAST_POSITION_M, np.radians(LEAST_YAW_DEG)], np.float32) ** 2
    return peak + ridge + jnp.diag(across_ridge + least)


def _ridge_covariance(
    products: Complex[Array, "t s f"],
    pose: Float[Array, " 3"],
    yaws: Float[Array, " t"],
    curvature: Float[Array, "3 3"],
    config: VerificationConfig,
) -> Float[Array, "3 3"]:
    """Covariance of (x, y, yaw) along the ridge of a peak: the direction in which the correlation falls least.

    Along a wall the correlation falls only because the two images share less area. In a bend the ridge rotates with the
    distance, so the best of several rotations counts. Samples beyond a minimum belong to another peak and count no more
    than the minimum.

    Arguments:
      products: Fourier transforms (`rfft2`) of the correlation at each rotation of `yaws`.
      pose: x, y (metres) and yaw (radians) of the peak.
      yaws: Rotations in radians. The first one is nearest to the peak and counts as its yaw.
      curvature: Negative Hessian of the correlation at the peak.
    """
    middle = int(config.max_shift_m / RIDGE_STEP_M)  # index of the peak among the samples
    along_m = np.arange(-middle, middle + 1, dtype=np.float32) * np.float32(RIDGE_STEP_M)
    yaw_offsets = jnp.asarray(yaws - pose[2]).at[0].set(0.0)
    # Curvature in x and y if each position has its best yaw. Its weak eigenvector is the direction of the ridge.
    coupling = curvature[:2, 2:] * curvature[2:, :2] / jnp.maximum(curvature[2, 2], 1e-4)
    planar = curvature[:2, :2] - coupling
    ridge_angle = jnp.arctan2(2 * planar[0, 1], planar[0, 0] - planar[1, 1]) / 2 + np.float32(np.pi / 2)
    headings = ridge_angle + yaw_offsets / 2  # a bent ridge is an arc, and its chord turns by half of the angle
    shifts = along_m[None, :, None] * jnp.stack([jnp.cos(headings), jnp.sin(headings)], axis=1)[:, None]
    points = pose[None, None, :2] + shifts  # samples by rotation, distance along the ridge, and axis
    area = _shared_area(jnp.hypot(points[..., 0], points[..., 1]), config.reach_m)
    heights = jax.vmap(_heights)(products, points) / area
    share = heights.max(0) / jnp.maximum(heights[0, middle], 1e-6)
    falling_before, falling_after = jax.lax.cummin(share[middle::-1])[::-1], jax.lax.cummin(share[middle:])
    share = jnp.concatenate([falling_before, falling_after[1:]])
    best = heights.argmax(0)
    offsets = jnp.concatenate([shifts[best, np.arange(len(along_m))], yaw_offsets[best][:, None]], axis=1)
    inside = (jnp.abs(points[0]).max(1) <= config.max_shift_m + RIDGE_STEP_M) | (along_m == 0)
    weight = jnp.where(inside, jnp.exp(-jnp.maximum(1 - share, 0) / RIDGE_DROP), 0)
    beyond_peak = (np.abs(along_m) >= RIDGE_START_M).astype(np.float32)  # nearer samples are in the curvature
    return jnp.einsum("k,ki,kj->ij", weight * beyond_peak, offsets, offsets) / weight.sum()


def _heights(product: Complex[Array, "s f"], points: Float[Array, "k 2"]) -> Float[Array, " k"]:
    """Correlation without high frequencies at points (x, y) in metres, up to a common factor.

    `product` is the Fourier transform (`rfft2`) of the correlation. Only frequencies below `RIDGE_BAND` are used.
    """
    size = product.shape[0]
    band = int(RIDGE_BAND * size)
    low = jnp.concatenate([product[-band:, :band], product[:band, :band]])
    phases = points * np.float32(2 * np.pi / (DENSITY_RESOLUTION_M * size))
    rows = jnp.exp(-1j * phases[:, 1:] * np.arange(-band, band, dtype=np.float32)[None])  # rows run down, y runs up
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
    """Covariance of x, y (metres) and yaw (radians), in the match's frame, if this peak is the correct one."""
    correlation: Float[AnyArray, "*b"]
    """Correlation at the peak: 1 for equal images, about 0 for unrelated ones."""
    peak_ratio: Float[AnyArray, "*b"]
    """Correlation at the best other pose divided by that at this pose. It is near 1 if both fit."""

    @property
    def match_from_query(self) -> Float[np.ndarray, "4 4"]:
        """Pose of the query in the frame of the match. Not for arrays of poses."""
        return transform(float(self.x), float(self.y), float(self.yaw))

    @property
    def along_m(self) -> float:
        """Standard deviation of the position along its least certain direction, in metres. Not for arrays of poses."""
        return float(np.sqrt(np.linalg.eigvalsh(np.asarray(self.covariance)[:2, :2])[1]))

    def angle_to(self, yaw: float) -> float:
        """Angle between the yaw and another one, in radians, from 0 to pi. NaN if the other one is NaN."""
        return float(abs(wrap_angle(np.asarray(float(self.yaw) - float(yaw)))))


REFINE_DEG = 3.0
"""Range of the refinement in rotation to each side, in degrees."""
TURN_STEPS = 4
"""Number of steps of this range."""
RIDGE_TURNS = (0, 2, 6, 8)
"""Rotations at which a bent ridge is searched, besides that of the peak: indices from 0 to 2 * `TURN_STEPS`."""
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
    matches = match_spectra(jnp.asarray(match)[None], config=config)
    peaks = search(query_spectra(query, config=config), matches, config=config)
    return refine(query, match, peaks.at(0), config=config)


@functools.partial(jax.jit, static_argnames="config")
def refine(
    query: Num[Array | np.ndarray, "h w"],
    match: Num[Array | np.ndarray, "h w"],
    peak: CorrelationPeak,
    *,
    config: VerificationConfig = DEFAULT,
) -> BevRegistration:
    """Register two images near a peak of `search`, to a fraction of a cell. The images and errors are as in `align`."""
    peak_ratio = jnp.where(peak.correlation > 1e-3, peak.second / jnp.maximum(peak.correlation, 1e-6), 1.0)
    query, match = prepare_image(query, config), prepare_image(match, config)
    pose, correlation, covariance = _refine_peak(query, match, jnp.stack([peak.x, peak.y, peak.yaw]), config)
    yaw = jnp.mod(pose[2] + jnp.pi, 2 * jnp.pi) - jnp.pi
    return BevRegistration(pose[0], pose[1], yaw, covariance, correlation, peak_ratio)


def _refine_peak(
    query: Float[Array, "m m"], match: Float[Array, "m m"], start: Float[Array, " 3"], config: VerificationConfig
) -> tuple[Float[Array, " 3"], Float[Array, ""], Float[Array, "3 3"]]:
    """Peak of the correlation near a pose `start`.

    Returns its pose (x, y in metres, yaw in radians), its correlation, and the covariance of the pose.
    """
    cell_m, yaw_step = DENSITY_RESOLUTION_M, np.float32(np.radians(REFINE_DEG) / TURN_STEPS)
    yaws = start[2] + jnp.arange(-TURN_STEPS, TURN_STEPS + 1) * yaw_step
    product = spectrum(match[None], cell_m, config) * jnp.conj(spectrum(rotate(query, yaws), cell_m, config))
    size = product.shape[1]
    shifts_m = np.arange(-SHIFT_STEPS, SHIFT_STEPS + 1, dtype=np.float32) * (cell_m / 2)
    xs, ys = start[0] + shifts_m, start[1] + shifts_m
    rows = _fourier_factors(-ys / cell_m, np.fft.fftfreq(size))  # rows run down, y runs up
    columns = _fourier_factors(xs / cell_m, np.fft.rfftfreq(size)) * column_counts(size)
    volume = jnp.einsum("tij,yi,xj->xyt", product, rows, columns).real / size**2  # correlation by x, y and yaw
    peak = jnp.unravel_index(jnp.argmax(volume), volume.shape)
    centre = [jnp.clip(index, 1, n - 2) for index, n in zip(peak, volume.shape, strict=True)]
    block = jax.lax.dynamic_slice(volume, [index - 1 for index in centre], (3, 3, 3))
    value, gradient, hessian = _parabola(block)  # per step
    definite = hessian - 1e-6 * jnp.eye(3)  # negative definite, also for a flat peak
    offset = jnp.clip(jnp.linalg.solve(definite, -gradient), -1, 1)
    steps = jnp.array([cell_m / 2, cell_m / 2, yaw_step])
    pose = jnp.stack([xs[centre[0]], ys[centre[1]], yaws[centre[2]]]) + offset * steps
    correlation = value + gradient @ offset + offset @ hessian @ offset / 2
    curvature = -hessian / (steps[:, None] * steps[None])
    # Between plain walls the peak is a ridge. Its covariance follows from the correlations at a few yaws.
    nearest_turn = centre[2][None] + jnp.round(offset[2]).astype(int)
    turns = jnp.concatenate([nearest_turn, np.array(RIDGE_TURNS)])
    ridge = _ridge_covariance(product[turns], pose, yaws[turns], curvature, config)
    covariance = _peak_covariance(
        curvature,
        correlation,
        occupied=jnp.minimum((query > 0).sum(), (match > 0).sum()),
        apart_m=jnp.hypot(pose[0], pose[1]),
        ridge=ridge,
    )
    return pose, correlation, covariance


def _fourier_factors(shifts: Float[Array, " k"], frequencies: Float[np.ndarray, " f"]) -> Complex[Array, "k f"]:
    """Factors exp(2 pi i shift frequency) of a Fourier series, for shifts in cells and frequencies in cycles a cell."""
    return jnp.exp(2j * np.pi * shifts[:, None] * jnp.asarray(frequencies, jnp.float32)[None])


def _parabola(block: Float[Array, "3 3 3"]) -> tuple[Float[Array, ""], Float[Array, " 3"], Float[Array, "3 3"]]:
    """Value, gradient and Hessian at the centre of the quadratic function that fits 27 values best (least squares)."""
    offsets = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), -1).reshape(27, 3)
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    columns = [np.ones(27), *offsets.T, *(offsets[:, i] * offsets[:, j] for i, j in pairs)]
    # 10 coefficients: constant, 3 linear ones, and 6 products, which are the upper half of the Hessian.
    coefficients = jnp.asarray(np.linalg.pinv(np.stack(columns, 1)), jnp.float32) @ block.reshape(27)
    upper = jnp.zeros((3, 3)).at[tuple(np.array(pairs).T)].set(coefficients[4:])
    return coefficients[0], coefficients[1:4], upper + upper.T
