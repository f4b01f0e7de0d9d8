"""Covariance of the registration of two scans, for points with correlated errors.

Points on one surface, ring or vehicle have correlated errors. Their contributions are summed in blocks of space, and
the scatter of the blocks gives the noise (a sandwich estimator). The constants were fitted on simulated drives with 64,
32 and 16 beams (`benchmarks/quality/poses.py`).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

NEIGHBOURS = 20
"""Number of neighbours from which the normal of a point is estimated. With 10, normals on the rings of 16 beams are
arbitrary, and GICP aligns the rings of the two scans. Roll and pitch were 0.3 degrees off."""
POINTS = 4000
"""Target number of points of the query for the covariance. Clouds with fewer points are not thinned."""
BLOCK_M = 8.0
"""Edge of the blocks of space with independent errors, in metres."""
SCALE, HEIGHT_SCALE = 1.15, 0.8
"""Factor of all standard deviations, and additional factor of the height."""
SPARSE, SPARSE_TILT = 3.2, 9.0
"""Growth of standard deviations with the share of sparse ground: of x, y and yaw, and of roll and pitch. Ground is
sparse where the neighbours of a point lie on one line, so that its normal is arbitrary."""
FLAT_COSINE = 0.9
"""Minimum cosine between the z axis and the normal of a surface that is ground."""
LINE = 0.05
"""Maximum ratio of the second to the first variance of neighbours that lie on a line."""
SLIDING = 0.04
"""Share of the squared components of all normals below which a direction is degenerate: scans can slide along it."""
UNKNOWN_M = 3.0
"""Standard deviation along a degenerate direction if the first guess has no covariance, in metres."""


class Matched(NamedTuple):
    """Points of a query, each with its nearest neighbour in the match."""

    points: Float[np.ndarray, "k 3"]
    """Points in the query's frame, in metres."""
    residuals: Float[np.ndarray, "k 3"]
    """Vector from each transformed point to its neighbour, in the match's frame."""
    weights: Float[np.ndarray, "k 3 3"]
    """Inverse covariances of the residuals, as in GICP."""
    normals: Float[np.ndarray, "k 3"]
    """Normals of the neighbours' surfaces, in the query's frame."""
    each: int
    """Number of points of the query that each of these represents."""
    sparse: float
    """Share of the ground where the neighbours of a point lie on one line."""


def registration_covariance(
    information: Float[np.ndarray, "6 6"],
    matched: Matched,
    match_from_query: Float[np.ndarray, "4 4"],
    initial_covariance: Float[np.ndarray, "6 6"] | None,
) -> Float[np.ndarray, "6 6"]:
    """Return the covariance of a small motion of the query in its own frame: metres, then radians.

    `information` is GICP's matrix of the same motion. The covariance of the first guess is kept along degenerate
    directions.
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
    """Find the nearest neighbours of a subset of the query's points, at most `max_apart_m` metres away.

    `match`, its search tree `tree`, and `query` are results of small_gicp's `preprocess_points`.
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
    """Scatter of the gradient of GICP's error over blocks of space."""
    pull = np.einsum("kij,kj->ki", matched.weights, matched.residuals) @ match_from_query[:3, :3]
    gradient = np.concatenate([pull, np.cross(matched.points, pull)], axis=1)
    _, block = np.unique(np.floor(matched.points / BLOCK_M).astype(np.int64), axis=0, return_inverse=True)
    sums = np.zeros((block.max(initial=-1) + 1, 6))
    np.add.at(sums, block.reshape(-1), gradient)
    return sums.T @ sums * matched.each**2


def _sliding(
    normals: Float[np.ndarray, "k 3"], initial_covariance: Float[np.ndarray, "6 6"] | None
) -> Float[np.ndarray, "3 3"]:
    """Position covariance of the first guess along degenerate directions."""
    strengths, directions = np.linalg.eigh(normals.T @ normals)
    shares = strengths / max(strengths.sum(), 1e-9)
    guess = np.eye(3) * UNKNOWN_M**2 if initial_covariance is None else initial_covariance[:3, :3]
    kept = np.exp(-((shares / SLIDING) ** 2)) * np.einsum("ij,ik,kj->j", directions, guess, directions)
    return (directions * kept) @ directions.T


def _sparse_ground(cloud: Float[np.ndarray, "n 3"], tree: Any, rows: Int[np.ndarray, " k"]) -> float:
    """Share of the points of flat ground whose neighbours lie on one line."""
    if not len(rows):
        return 1.0
    neighbours = cloud[np.asarray(tree.batch_knn_search(cloud[rows], NEIGHBOURS)[0]).astype(np.int64)]
    neighbours = neighbours - neighbours.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("kna,knb->kab", neighbours, neighbours))
    flat = np.abs(axes[:, 2, 0]) > FLAT_COSINE
    return float(np.mean(spread[flat, 1] < LINE * spread[flat, 2])) if flat.any() else 1.0
