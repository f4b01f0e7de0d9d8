"""The covariance of a registration of two scans: what the points at hand say, not what as many independent ones would.

Neighbouring points err together: they lie on one surface, one ring of the sensor, one vehicle that has moved. Their
contributions are added up in blocks of space, and the scatter of the blocks gives the noise (a sandwich estimator). The
constants were fitted on simulated drives with 64, 32 and 16 beams (`benchmarks/covariance.py`).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

NEIGHBOURS = 20
"""Neighbours of a point from which its normal is estimated. With 10, normals on the rings of 16 beams are arbitrary,
and GICP holds the rings of one scan on those of the other: roll and pitch were .3 degrees off."""
POINTS = 4000
"""Maximum number of points of the query that the covariance is computed from."""
BLOCK_M = 8.0
"""Edge of the blocks of space whose errors are taken as independent."""
SCALE, HEIGHT_SCALE = 1.15, 0.8
"""Factor of all standard deviations, and of that of the height besides."""
SPARSE, SPARSE_TILT = 3.2, 9.0
"""The standard deviations grow by these factors times the share of the ground where the neighbours of a point lie on
one line, because a normal is a guess there: position and yaw by the first, roll and pitch by the second."""
FLAT_COSINE = 0.9
"""A surface is ground if its normal is closer to the z axis than this cosine."""
LINE = 0.05
"""Neighbours lie on a line if the second of their variances is less than this fraction of the first."""
SLIDING = 0.04
"""Normals point along every direction; one along which their squared components make up less than this share is
degenerate, and the scans slide along it."""
UNKNOWN_M = 3.0
"""Standard deviation along a degenerate direction, where the first guess has no covariance."""


class Matched(NamedTuple):
    """Points of a query, each with its nearest neighbour in the match."""

    points: Float[np.ndarray, "k 3"]
    """In the query's frame."""
    residuals: Float[np.ndarray, "k 3"]
    """From each point, moved, to its neighbour, in the match's frame."""
    weights: Float[np.ndarray, "k 3 3"]
    """Inverse covariances of the residuals, as GICP has them."""
    normals: Float[np.ndarray, "k 3"]
    """Of the neighbours' surfaces, in the query's frame."""
    each: int
    """How many points of the query each of these stands for."""
    sparse: float
    """The share of the ground where points have neighbours along one line only."""


def registration_covariance(
    information: Float[np.ndarray, "6 6"],
    matched: Matched,
    match_from_query: Float[np.ndarray, "4 4"],
    initial_covariance: Float[np.ndarray, "6 6"] | None,
) -> Float[np.ndarray, "6 6"]:
    """Return the covariance of a small motion of the query in its own frame: metres, then radians.

    Arguments:
      information: GICP's matrix, of the same motion.
      matched: the points that correspond.
      match_from_query: the pose that was found.
      initial_covariance: that of the first guess, which is kept along degenerate directions.
    """
    inverse = np.linalg.pinv(information, hermitian=True)
    grow = np.repeat(SCALE * (1 + np.array([SPARSE, SPARSE_TILT]) * matched.sparse), 3)
    grow[[2, 5]] = SCALE * HEIGHT_SCALE, grow[0]
    found = (inverse @ _noise(matched, match_from_query) @ inverse) * np.outer(grow, grow)
    found[:3, :3] += _sliding(matched.normals, initial_covariance)
    return found


def matched_points(
    match: Any, tree: Any, query: Any, match_from_query: Float[np.ndarray, "4 4"], *, max_apart_m: float
) -> Matched:
    """Look up the nearest neighbours of some of the query's points.

    Arguments:
      match, tree, query: what small_gicp's `preprocess_points` returns for both scans.
      match_from_query: the pose that was found.
      max_apart_m: points farther apart do not correspond.
    """
    turn = match_from_query[:3, :3]
    points, theirs = (np.asarray(cloud.points())[:, :3] for cloud in (query, match))
    each = max(1, len(points) // POINTS)
    moved = points[::each] @ turn.T + match_from_query[:3, 3]
    nearest, squares = (np.asarray(values) for values in tree.batch_nearest_neighbor_search(moved))
    near = np.flatnonzero(squares < max_apart_m**2)
    nearest = nearest[near].astype(np.int64)
    ours_spread = np.stack([query.cov(int(i) * each)[:3, :3] for i in near]) if len(near) else np.zeros((0, 3, 3))
    theirs_spread = np.stack([match.cov(int(i))[:3, :3] for i in nearest]) if len(near) else np.zeros((0, 3, 3))
    return Matched(
        points=points[::each][near],
        residuals=theirs[nearest] - moved[near],
        weights=np.linalg.inv(theirs_spread + turn @ ours_spread @ turn.T),
        normals=np.linalg.eigh(theirs_spread)[1][:, :, 0] @ turn,
        each=each,
        sparse=_sparse_ground(theirs, tree, nearest[::4]),
    )


def _noise(matched: Matched, match_from_query: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 6"]:
    """The scatter of the gradient of GICP's error, in blocks of space."""
    pull = np.einsum("kij,kj->ki", matched.weights, matched.residuals) @ match_from_query[:3, :3]
    gradient = np.concatenate([pull, np.cross(matched.points, pull)], axis=1)
    _, block = np.unique(np.floor(matched.points / BLOCK_M).astype(np.int64), axis=0, return_inverse=True)
    sums = np.zeros((block.max(initial=-1) + 1, 6))
    np.add.at(sums, block.reshape(-1), gradient)
    return sums.T @ sums * matched.each**2


def _sliding(
    normals: Float[np.ndarray, "k 3"], initial_covariance: Float[np.ndarray, "6 6"] | None
) -> Float[np.ndarray, "3 3"]:
    """The first guess's covariance of the position, along the directions in which no surface holds the scans."""
    strengths, directions = np.linalg.eigh(normals.T @ normals)
    shares = strengths / max(strengths.sum(), 1e-9)
    guess = np.eye(3) * UNKNOWN_M**2 if initial_covariance is None else initial_covariance[:3, :3]
    kept = np.exp(-((shares / SLIDING) ** 2)) * np.einsum("ij,ik,kj->j", directions, guess, directions)
    return (directions * kept) @ directions.T


def _sparse_ground(cloud: Float[np.ndarray, "n 3"], tree: Any, rows: Int[np.ndarray, " k"]) -> float:
    """The share of the points of flat ground whose neighbours lie on one line."""
    if not len(rows):
        return 1.0
    neighbours = cloud[np.asarray(tree.batch_knn_search(cloud[rows], NEIGHBOURS)[0]).astype(np.int64)]
    neighbours = neighbours - neighbours.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("kna,knb->kab", neighbours, neighbours))
    flat = np.abs(axes[:, 2, 0]) > FLAT_COSINE
    return float(np.mean(spread[flat, 1] < LINE * spread[flat, 2])) if flat.any() else 1.0
