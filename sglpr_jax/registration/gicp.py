"""Registration of two scans in 6 degrees of freedom by GICP, from a first guess.

GICP does not detect whether the scans show one place. If it starts 3 m off along a road, its result is 3 m off,
too. The overlap of the registered scans shows such errors.

Points on one surface, ring or vehicle have correlated errors. For the covariance, their contributions are summed in
blocks of space, and the scatter of the blocks gives the noise (a sandwich estimator). The constants were fitted on
simulated drives with 64, 32 and 16 beams (`benchmarks/quality/poses.py`).
"""

from typing import Any, NamedTuple

import numpy as np
import small_gicp
from jaxtyping import Float, Float32, Int

from sglpr_jax.se3 import transformed

VOXEL_M = 0.25
"""Edge length of the voxels of GICP, in metres."""
NEIGHBOURS = 20
"""Number of neighbours from which the normal of a point is estimated. With 10, normals on the rings of 16 beams are
arbitrary, and GICP aligns the rings of the two scans: roll and pitch were 0.3 degrees off."""
MAX_APART_M, ITERATIONS = 1.0, 40
"""Maximum distance of corresponding points in GICP, in metres, and maximum number of iterations."""
OVERLAP_VOXEL_M, OVERLAP_REACH_M = 1.0, 40.0
"""Edge length of the voxels of the overlap, and maximum distance of counted points from both sensors, in metres."""
POINTS = 4000
"""Target number of points of the query for the covariance. Clouds with fewer points are not thinned."""
BLOCK_M = 8.0
"""Edge length of the blocks of space with independent errors, in metres."""
SCALE, HEIGHT_SCALE = 1.15, 0.8
"""Factor of all standard deviations, and additional factor of the height."""
SPARSE, SPARSE_TILT = 3.2, 9.0
"""Relative growth of standard deviations if all ground is sparse: of x, y and yaw, and of roll and pitch. Ground is
sparse where the neighbours of a point lie on one line, so that its normal is arbitrary."""
FLAT_COSINE, LINE = 0.9, 0.05
"""Minimum cosine between the z axis and the normal of ground, and maximum ratio of the second to the first variance of
neighbours that lie on a line."""
SLIDING = 0.04
"""Share of the squared components of all normals along a direction, below which scans can slide along it."""
LEAST_POSITION_M, LEAST_ROTATION_DEG = 0.002, 0.005
"""Standard deviations added to every covariance, in metres and degrees."""


class Registration(NamedTuple):
    """Pose of a query in the frame of a match, with covariance and overlap."""

    match_from_query: Float[np.ndarray, "4 4"]
    """Pose of the query in the frame of the match, in metres."""
    covariance: Float[np.ndarray, "6 6"]
    """Covariance of a small motion of the query in its own frame: x, y, z in metres, then rotations about x, y, z in
    radians."""
    overlap: float
    """Overlap of the registered scans, from 0 to 1 (see `overlap`)."""


def register(
    query: Float32[np.ndarray, "n 3"],
    match: Float32[np.ndarray, "m 3"],
    *,
    initial: Float[np.ndarray, "4 4"],
    initial_covariance: Float[np.ndarray, "6 6"],
) -> Registration:
    """Register the scan of a query to the scan of a match.

    Arguments:
      query: Points of the query in a gravity-aligned frame of its sensor, in metres.
      match: The same for the match. The covariance treats height and ground differently, so z must point up.
      initial: First guess of `match_from_query`, within a metre and a few degrees.
      initial_covariance: Covariance of the first guess, of a small motion of the query in its own frame. The result
        keeps it along directions in which the scans can slide on each other, as in a tunnel.

    Raises:
      ValueError: If a scan has fewer than 100 finite points.
    """
    query, match = _finite(query, "query"), _finite(match, "match")
    match_cloud, match_tree = _preprocess(match)
    query_cloud, _ = _preprocess(query)
    result = small_gicp.align(
        match_cloud,
        query_cloud,
        match_tree,
        init_T_target_source=np.asarray(initial, np.float64),
        registration_type="GICP",
        max_correspondence_distance=MAX_APART_M,
        max_iterations=ITERATIONS,
    )
    pose = np.asarray(result.T_target_source)
    order = np.array([3, 4, 5, 0, 1, 2])  # small_gicp puts rotations before translations
    information = np.asarray(result.H)[order][:, order]
    covariance = _registration_covariance(information, query_cloud, match_cloud, match_tree, pose, initial_covariance)
    least = np.repeat([LEAST_POSITION_M, np.radians(LEAST_ROTATION_DEG)], 3) ** 2
    return Registration(pose, covariance + np.diag(least), overlap(query, match, pose))


def overlap(
    query: Float[np.ndarray, "n 3"], match: Float[np.ndarray, "m 3"], match_from_query: Float[np.ndarray, "4 4"]
) -> float:
    """Number of voxels with points of both scans, divided by the number of voxels of the scan that has fewer.

    Only voxels within `OVERLAP_REACH_M` of both sensors count. The overlap is 0 if one of the scans has none.
    """
    sensors = np.zeros(3), match_from_query[:3, 3]
    side = 2 * int(OVERLAP_REACH_M / OVERLAP_VOXEL_M) + 4  # of a cube of voxels around the match's sensor
    voxels = []
    for cloud in (transformed(match_from_query, query), match):
        near = np.all([np.linalg.norm(cloud - sensor, axis=1) < OVERLAP_REACH_M for sensor in sensors], axis=0)
        x, y, z = np.floor(cloud[near] / OVERLAP_VOXEL_M).astype(np.int64).T + side // 2
        voxels.append(np.unique((z * side + y) * side + x))
    smaller_count = min(map(len, voxels))
    return len(np.intersect1d(*voxels, assume_unique=True)) / smaller_count if smaller_count else 0.0


def _preprocess(cloud: Float32[np.ndarray, "n 3"]) -> tuple[Any, Any]:
    """Downsample a cloud and estimate the covariance of the surface at each point. Returns cloud and search tree."""
    options = {"downsampling_resolution": VOXEL_M, "num_neighbors": NEIGHBOURS}
    return small_gicp.preprocess_points(cloud.astype(np.float64), **options)


def _finite(points: Float32[np.ndarray, "n 3"], name: str) -> Float32[np.ndarray, "n 3"]:
    """Remove points that are not finite. Raises ValueError, which names the scan, if fewer than 100 points are left."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise ValueError(f"expected a {name} of 100 finite points or more to register, found {len(points)}")
    return points


def _registration_covariance(
    information: Float[np.ndarray, "6 6"],
    query: Any,
    match: Any,
    tree: Any,
    match_from_query: Float[np.ndarray, "4 4"],
    initial_covariance: Float[np.ndarray, "6 6"],
) -> Float[np.ndarray, "6 6"]:
    """Covariance of a small motion of the query in its own frame: x, y, z in metres, then rotations in radians.

    It is the inverse of `information` (GICP's matrix of the same motion), times the scatter of the gradients of blocks
    of space, times the inverse again. Along directions in which the scans can slide, the covariance of the first guess
    is added. Clouds and search tree are results of `_preprocess`.
    """
    rotation = match_from_query[:3, :3]
    query_points, match_points = (np.asarray(cloud.points())[:, :3] for cloud in (query, match))
    # Pairs of a point of the thinned query and its nearest point of the match.
    stride = max(1, len(query_points) // POINTS)
    thinned = query_points[::stride]
    moved = thinned @ rotation.T + match_from_query[:3, 3]
    match_rows, squared_m = map(np.asarray, tree.batch_nearest_neighbor_search(moved))
    near = np.flatnonzero(squared_m < MAX_APART_M**2)
    points, match_rows = thinned[near], match_rows[near].astype(np.int64)
    query_surface = np.array([query.cov(int(row) * stride)[:3, :3] for row in near]).reshape(-1, 3, 3)
    match_surface = np.array([match.cov(int(row))[:3, :3] for row in match_rows]).reshape(-1, 3, 3)
    weights = np.linalg.inv(match_surface + rotation @ query_surface @ rotation.T)
    # Gradient of GICP's error by each pair, summed in blocks of space.
    force = np.einsum("kij,kj->ki", weights, match_points[match_rows] - moved[near]) @ rotation
    gradient = np.concatenate([force, np.cross(points, force)], axis=1)
    _, block = np.unique(np.floor(points / BLOCK_M).astype(np.int64), axis=0, return_inverse=True)
    sums = np.zeros((block.max(initial=-1) + 1, 6))
    np.add.at(sums, block.reshape(-1), gradient)
    scatter = sums.T @ sums * stride**2
    inverse = np.linalg.pinv(information, hermitian=True)
    sparse_share = _sparse_ground(match_points, tree, match_rows[::4])
    growth = np.repeat(SCALE * (1 + np.array([SPARSE, SPARSE_TILT]) * sparse_share), 3)
    growth[2] = SCALE * HEIGHT_SCALE  # height does not grow
    growth[5] = growth[0]  # yaw grows as x and y do
    covariance = (inverse @ scatter @ inverse) * np.outer(growth, growth)
    normals = np.linalg.eigh(match_surface)[1][:, :, 0] @ rotation  # in the query's frame
    covariance[:3, :3] += _sliding_covariance(normals, initial_covariance)
    return covariance


def _sliding_covariance(
    normals: Float[np.ndarray, "k 3"], initial_covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "3 3"]:
    """Position covariance of the first guess along directions in which scans with these surface normals can slide."""
    squared_sums, directions = np.linalg.eigh(normals.T @ normals)
    shares = squared_sums / max(squared_sums.sum(), 1e-9)
    along_directions = np.einsum("ij,ik,kj->j", directions, initial_covariance[:3, :3], directions)
    variances = np.exp(-((shares / SLIDING) ** 2)) * along_directions
    return (directions * variances) @ directions.T


def _sparse_ground(cloud: Float[np.ndarray, "n 3"], tree: Any, rows: Int[np.ndarray, " k"]) -> float:
    """Share of the flat points among `rows` of a cloud whose neighbours lie on one line. 1 without flat points."""
    if not len(rows):
        return 1.0
    neighbours = cloud[np.asarray(tree.batch_knn_search(cloud[rows], NEIGHBOURS)[0]).astype(np.int64)]
    neighbours = neighbours - neighbours.mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("kna,knb->kab", neighbours, neighbours))
    is_flat = np.abs(axes[:, 2, 0]) > FLAT_COSINE  # z of the normal, the axis of the least variance
    return float(np.mean(variances[is_flat, 1] < LINE * variances[is_flat, 2])) if is_flat.any() else 1.0
