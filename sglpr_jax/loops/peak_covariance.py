"""Covariance of a pose from the shape of the correlation peak: small at a corner, long along a wall.

It is the sum of three parts: least squares at the peak (curvature and image noise), the extent of the ridge under the
peak, and small fixed errors. The constants were fitted on simulated drives (`benchmarks/quality/covariance.py`).
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

NOISE = 0.8
NOISE_CELLS = 300.0
NOISE_RANGE_M = 10.0
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


def peak_covariance(
    curvature: Float[Array, "3 3"],
    correlation: Float[Array, ""],
    *,
    occupied: Int[Array, ""],
    apart_m: Float[Array, ""],
    ridge: Float[Array, "3 3"],
) -> Float[Array, "3 3"]:
    """Return the covariance of (x, y, yaw) at a peak, in metres and radians.

    Arguments:
      curvature: Negative Hessian of the correlation at the peak.
      correlation: Height of the peak.
      occupied: Number of occupied cells of the image that has fewer.
      apart_m: Distance between the two scans, in metres.
      ridge: Covariance from `ridge_covariance`.
    """
    height = jnp.clip(correlation, 0.05, 0.999)
    noise = NOISE * (1 - height) / height * (1 / jnp.maximum(occupied, 1) + 1 / NOISE_CELLS)
    noise = noise * (1 + (apart_m / NOISE_RANGE_M) ** 2)
    strengths, directions = jnp.linalg.eigh(curvature)
    spread = noise / (jnp.maximum(strengths, 0) + noise / FLAT_M**2)
    peak = (directions * spread[None]) @ directions.T
    others = jnp.trace(ridge[:2, :2]) * np.array([RIDGE_ACROSS, RIDGE_ACROSS, RIDGE_YAW], np.float32) ** 2
    least = np.array([LEAST_POSITION_M, LEAST_POSITION_M, np.radians(LEAST_YAW_DEG)], np.float32) ** 2
    return peak + ridge + jnp.diag(others + least)


def ridge_covariance(
    products: Complex[Array, "t s f"],
    pose: Float[Array, " 3"],
    yaws: Float[Array, " t"],
    curvature: Float[Array, "3 3"],
    *,
    cell_m: float,
    reach_m: float,
    max_shift_m: float,
) -> Float[Array, "3 3"]:
    """Return the covariance of (x, y, yaw) along the weak axis of a peak, as far as the correlation stays high there.

    Along a wall the correlation falls only because the two images share less area. A pattern that moves with the sensor
    can leave a small peak on top of this ridge. In a bend the ridge rotates with the distance, so the best of several
    rotations counts. Samples beyond a minimum belong to another peak and count no more than the minimum.

    Arguments:
      products: Fourier transform (`rfft2`) of the correlation for each rotation of the query. The first is that of the
        peak.
      pose: x (right) and y (up) of the peak, in metres, and its yaw, in radians.
      yaws: Rotations, in radians.
      curvature: Negative Hessian of the correlation at the peak, over x, y and yaw.
      cell_m: Edge of a cell, in metres.
      reach_m: Radius of the images, in metres.
      max_shift_m: Maximum shift along x and y, in metres.
    """
    steps = int(max_shift_m / RIDGE_STEP_M)
    along = np.arange(-steps, steps + 1, dtype=np.float32) * np.float32(RIDGE_STEP_M)
    turned = jnp.asarray(yaws - pose[2]).at[0].set(0.0)
    heading = _weak_axis(curvature) + turned / 2  # the chord of an arc
    moved = along[None, :, None] * jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=1)[:, None]
    points = pose[None, None, :2] + moved
    area = _shared_area(jnp.hypot(points[..., 0], points[..., 1]), reach_m)
    heights = jax.vmap(functools.partial(_heights, cell_m=cell_m))(products, points) / area
    share = heights.max(0) / jnp.maximum(heights[0, steps], 1e-6)
    share = jnp.concatenate([jax.lax.cummin(share[steps::-1])[::-1], jax.lax.cummin(share[steps:])[1:]])
    best = heights.argmax(0)
    apart = jnp.concatenate([moved[best, np.arange(len(along))], turned[best][:, None]], axis=1)
    inside = (jnp.abs(points[0]).max(1) <= max_shift_m + RIDGE_STEP_M) | (along == 0)
    weight = jnp.where(inside, jnp.exp(-jnp.maximum(1 - share, 0) / RIDGE_DROP), 0)
    outside = (np.abs(along) >= RIDGE_START_M).astype(np.float32)
    return jnp.einsum("k,ki,kj->ij", weight * outside, apart, apart) / weight.sum()


def _weak_axis(curvature: Float[Array, "3 3"]) -> Float[Array, ""]:
    """Angle of the direction in the plane along which the correlation, at the best yaw, changes least."""
    planar = curvature[:2, :2] - jnp.outer(curvature[:2, 2], curvature[2, :2]) / jnp.maximum(curvature[2, 2], 1e-4)
    return jnp.arctan2(2 * planar[0, 1], planar[0, 0] - planar[1, 1]) / 2 + np.float32(np.pi / 2)


def _heights(product: Complex[Array, "s f"], points: Float[Array, "k 2"], cell_m: float) -> Float[Array, " k"]:
    """Low frequencies of a correlation at given points, up to a common factor."""
    size = product.shape[0]
    band = int(RIDGE_BAND * size)
    kept = jnp.concatenate([product[-band:, :band], product[:band, :band]])
    phases = points * np.float32(2 * np.pi / (cell_m * size))
    rows = jnp.exp(-1j * phases[:, 1:] * np.arange(-band, band, dtype=np.float32)[None])
    columns = jnp.exp(1j * phases[:, :1] * np.arange(band, dtype=np.float32)[None])
    twice = np.where(np.arange(band) == 0, 1, 2).astype(np.float32)  # half of a real image's spectrum is stored
    return ((rows @ kept) * columns).real @ twice


def _shared_area(apart_m: Float[Array, "*b"], reach_m: float) -> Float[Array, "*b"]:
    """Fraction of a circle of radius `reach_m` that overlaps with an equal circle at this distance."""
    ratio = jnp.minimum(apart_m / (2 * reach_m), 0.95)
    return (jnp.arccos(ratio) - ratio * jnp.sqrt(1 - ratio**2)) * np.float32(2 / np.pi)
