"""M2DP (He, Wang and Zhang, 2016): how the points lie on many planes, as the first singular vectors of the counts."""

import numpy as np
from jaxtyping import Float32, Float64

from sglpr_jax.methods.method import HandcraftedMethod

AZIMUTHS = 4
ELEVATIONS = 16
RINGS = 8
SECTORS = 16
PLANES = AZIMUTHS * ELEVATIONS
BINS = RINGS * SECTORS
NUMBERS = PLANES + BINS


def m2dp(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "192"]:
    """Return [u1; v1], 64 + 128 numbers, of `signature(points)` = U S V^T. No points give zeros.

    The signature is nowhere negative, so neither need u1 and v1 be: that settles their signs.
    """
    if not len(points):
        return np.zeros(NUMBERS, np.float32)
    left, _, right = np.linalg.svd(signature(points), full_matrices=False)
    return np.abs(np.concatenate([left[:, 0], right[0]])).astype(np.float32)


def signature(points: Float32[np.ndarray, "n 3"]) -> Float64[np.ndarray, "64 128"]:
    """Return for every plane the share of the points in each of its 8 rings x 16 sectors; n is at least 1.

    The points (metres) are moved to their mean and rotated into their principal axes. Plane (theta, phi) goes through
    the mean with the normal (cos theta cos phi, cos theta sin phi, sin theta), for 16 elevations theta from 0 to 90
    degrees and 4 azimuths phi from -90 to 90; its axes are those of `plane_axes`. The rings end at (k sqrt(rho) / 8)^2,
    rho being the farthest point's distance.
    """
    aligned = np.ascontiguousarray(_align(points.astype(np.float64)).T, np.float32)
    farthest = np.sqrt(np.max(np.sum(aligned**2, axis=0)))
    counts = np.stack([_count(np.einsum("ad,dn->an", axes, aligned), farthest) for axes in plane_axes()])
    return counts / len(points)


def plane_axes() -> Float32[np.ndarray, "64 2 3"]:
    """Return for each plane its axes p_x = e_x - (e_x . n) n and p_y = n x p_x, n being its normal.

    They are as long as the x axis of space, seen from the normal: from 1 down to 1/2. The published code leaves them
    so: the more a plane is oblique to x, the nearer to its centre points are counted.
    """
    phi, theta = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, AZIMUTHS), np.linspace(0, np.pi / 2, ELEVATIONS), indexing="ij"
    )
    normal = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), np.sin(theta)], axis=-1).reshape(-1, 3)
    x = np.array([1.0, 0, 0]) - normal[:, :1] * normal
    return np.stack([x, np.cross(normal, x)], axis=1).astype(np.float32)


def _align(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Return the points about their mean, in their principal axes, the longest first.

    An axis is known but for its sign. The first two point to where the third moment is positive, which rotates with
    the scan; the third makes them right-handed.
    """
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    first, second = (axis if np.sum((centred @ axis) ** 3) >= 0 else -axis for axis in (axes[:, 2], axes[:, 1]))
    return centred @ np.stack([first, second, np.cross(first, second)], axis=1)


def _count(projected: Float32[np.ndarray, "2 n"], farthest: np.float32) -> Float64[np.ndarray, "128"]:
    """Return how many points lie in each bin of a plane, ring by ring; the last ring has its outer border too."""
    x, y = projected
    share = np.hypot(x, y) / max(farthest, np.finfo(np.float32).tiny)
    ring = np.minimum(np.sqrt(share) * RINGS, RINGS - 1).astype(np.int32)
    angle = np.arctan2(y, x) / np.float32(2 * np.pi) + np.float32(0.5)
    sector = np.minimum(angle * SECTORS, SECTORS - 1).astype(np.int32)
    return np.bincount(ring * SECTORS + sector, minlength=BINS).astype(np.float64)


M2DP = HandcraftedMethod(
    "m2dp",
    'He, Wang and Zhang, "M2DP", IROS 2016',
    "points",
    m2dp,
)
