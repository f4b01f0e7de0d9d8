"""M2DP (He, Wang and Zhang, 2016): point counts on many planes, summarised by their first singular vectors."""

import numpy as np
from jaxtyping import Float32, Float64

AZIMUTHS = 4
ELEVATIONS = 16
RINGS = 8
SECTORS = 16
BINS = RINGS * SECTORS
NUMBERS = AZIMUTHS * ELEVATIONS + BINS


def m2dp(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "192"]:
    """Return [u1; v1], 64 + 128 numbers, of `signature(points)` = U S V^T. No points give zeros.

    The signature has no negative values, so u1 and v1 can be chosen without negative values. This fixes their signs.
    """
    if not len(points):
        return np.zeros(NUMBERS, np.float32)
    left, _, right = np.linalg.svd(signature(points), full_matrices=False)
    return np.abs(np.concatenate([left[:, 0], right[0]])).astype(np.float32)


def signature(points: Float32[np.ndarray, "n 3"]) -> Float64[np.ndarray, "64 128"]:
    """Return for every plane the fraction of the points (at least one, in metres) in each of its 8 rings x 16 sectors.

    The points are centred and rotated into their principal axes. Plane (theta, phi) contains the mean and has the
    normal (cos theta cos phi, cos theta sin phi, sin theta), for 16 elevations theta from 0 to 90 degrees and 4
    azimuths phi from -90 to 90 degrees. The outer radius of ring k is (k sqrt(rho) / 8)^2, where rho is the distance of
    the farthest point.
    """
    aligned = np.ascontiguousarray(_align(points.astype(np.float64)).T, np.float32)
    farthest = np.sqrt(np.max(np.sum(aligned**2, axis=0)))
    counts = np.stack([_count(np.einsum("ad,dn->an", axes, aligned), farthest) for axes in plane_axes()])
    return counts / len(points)


def plane_axes() -> Float32[np.ndarray, "64 2 3"]:
    """Return the axes p_x = e_x - (e_x . n) n and p_y = n x p_x of each plane with normal n.

    As in the published code, the axes have the length of the projected x axis, between 1/2 and 1.
    """
    phi, theta = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, AZIMUTHS), np.linspace(0, np.pi / 2, ELEVATIONS), indexing="ij"
    )
    normal = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), np.sin(theta)], axis=-1).reshape(-1, 3)
    x = np.array([1.0, 0, 0]) - normal[:, :1] * normal
    return np.stack([x, np.cross(normal, x)], axis=1).astype(np.float32)


def _align(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Return the centred points in their principal axes, the longest first. The first two have a positive third
    moment, because their signs are ambiguous; the third makes the system right-handed."""
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    first, second = (axis if np.sum((centred @ axis) ** 3) >= 0 else -axis for axis in (axes[:, 2], axes[:, 1]))
    return centred @ np.stack([first, second, np.cross(first, second)], axis=1)


def _count(projected: Float32[np.ndarray, "2 n"], farthest: np.float32) -> Float64[np.ndarray, "128"]:
    """Return the number of points in each bin of a plane, ring by ring. The last ring includes its outer border."""
    x, y = projected
    share = np.hypot(x, y) / max(farthest, np.finfo(np.float32).tiny)
    ring = np.minimum(np.sqrt(share) * RINGS, RINGS - 1).astype(np.int32)
    angle = np.arctan2(y, x) / np.float32(2 * np.pi) + np.float32(0.5)
    sector = np.minimum(angle * SECTORS, SECTORS - 1).astype(np.int32)
    return np.bincount(ring * SECTORS + sector, minlength=BINS).astype(np.float64)
