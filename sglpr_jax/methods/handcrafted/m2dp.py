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
    """Return the first left (64) and right (128) singular vector of the `signature`, without negative values."""
    if not len(points):
        return np.zeros(NUMBERS, np.float32)
    left, _, right = np.linalg.svd(signature(points), full_matrices=False)
    return np.abs(np.concatenate([left[:, 0], right[0]])).astype(np.float32)  # -u1 and -v1 are singular vectors, too


def signature(points: Float32[np.ndarray, "n 3"]) -> Float64[np.ndarray, "64 128"]:
    """Return for each of 64 planes the fraction of the points in each of its 8 rings x 16 sectors.

    The points (at least one) are centred and rotated into their principal axes, and then projected onto the planes
    through their mean (`plane_axes`). The outer radius of ring k is (k / 8)^2 times the distance of the farthest point.
    """
    aligned = np.ascontiguousarray(_align(points.astype(np.float64)).T, np.float32)
    farthest = np.sqrt(np.max(np.sum(aligned**2, axis=0)))
    counts = np.stack([_bin_counts(np.einsum("ad,dn->an", axes, aligned), farthest) for axes in plane_axes()])
    return counts / len(points)


def plane_axes() -> Float32[np.ndarray, "64 2 3"]:
    """Return two axes of each plane: the projection of the x axis, and the normal times this projection.

    The normals have 16 elevations theta from 0 to 90 degrees and 4 azimuths phi from -90 to 90 degrees. As in the
    published code, both axes have the length of the projected x axis, from 1/2 to 1.
    """
    phi, theta = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, AZIMUTHS), np.linspace(0, np.pi / 2, ELEVATIONS), indexing="ij"
    )
    normal = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), np.sin(theta)], axis=-1).reshape(-1, 3)
    projected_x = np.array([1.0, 0, 0]) - normal[:, :1] * normal
    return np.stack([projected_x, np.cross(normal, projected_x)], axis=1).astype(np.float32)


def _align(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Return the centred points in their principal axes, longest first. The first two have a positive third moment."""
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)  # shortest first
    first, second = (axis if np.sum((centred @ axis) ** 3) >= 0 else -axis for axis in (axes[:, 2], axes[:, 1]))
    return centred @ np.stack([first, second, np.cross(first, second)], axis=1)


def _bin_counts(projected: Float32[np.ndarray, "2 n"], farthest: np.float32) -> Float64[np.ndarray, "128"]:
    """Return the number of points in each bin of a plane, ring by ring. The last ring includes its outer border."""
    x, y = projected
    radius_share = np.hypot(x, y) / max(farthest, np.finfo(np.float32).tiny)
    ring = np.minimum(np.sqrt(radius_share) * RINGS, RINGS - 1).astype(np.int32)
    turn_share = np.arctan2(y, x) / np.float32(2 * np.pi) + np.float32(0.5)
    sector = np.minimum(turn_share * SECTORS, SECTORS - 1).astype(np.int32)
    return np.bincount(ring * SECTORS + sector, minlength=BINS).astype(np.float64)
