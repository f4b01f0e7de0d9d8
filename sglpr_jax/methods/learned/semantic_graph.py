"""Semantic graph of a labelled scan, the input of SGPR: clusters of equal class with their centres."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from sglpr_jax.data.recording import Record, check_cloud
from sglpr_jax.data.views import classes_of
from sglpr_jax.methods.voxel_means import voxels

NODES = 100


class Rule(NamedTuple):
    """Clustering of a class."""

    gap_m: float
    """Maximum distance of neighbouring points of a cluster, in metres."""
    points: int
    """Minimum number of points of a cluster."""


RULES = {
    1: Rule(0.5, 100),  # car
    4: Rule(0.5, 100),  # truck
    5: Rule(0.5, 100),  # other vehicle
    11: Rule(2.0, 300),  # sidewalk
    12: Rule(2.0, 300),  # other ground
    13: Rule(2.0, 300),  # building
    14: Rule(0.5, 100),  # fence
    15: Rule(2.0, 200),  # vegetation
    16: Rule(0.2, 50),  # trunk
    17: Rule(2.0, 300),  # terrain
    18: Rule(0.2, 100),  # pole
    19: Rule(0.2, 50),  # traffic sign
}
"""Published rules of the 12 classes of nodes. Other classes are ignored."""
MOST_POINTS = 50_000
"""Larger clusters are dropped."""
FINER = 4
"""Points are first merged into voxels whose side is the gap divided by this number."""


def semantic_graph(record: Record) -> Float32[np.ndarray, "100 15"]:
    """Return up to 100 nodes: x, y, z of the centre in metres, and the class as 12 numbers, one 1 and eleven 0.

    Missing nodes are zeros. If a scan has more than 100 clusters, those with the most points remain. The published
    graph has 100 random ones, and takes clusters from the instances of SemanticKITTI where a scan has them.

    Raises:
      ValueError: If the scan shows no place, or has no labels or no cluster.
    """
    points, classes = record.upright_points, classes_of(record, 20)
    check_cloud(points, name=record.name)
    finite = np.isfinite(points).all(axis=1)
    points, classes = points[finite], classes[finite]
    found = [_nodes(points[classes == category], column, rule) for column, (category, rule) in enumerate(RULES.items())]
    counts, nodes = (np.concatenate(parts) for parts in zip(*found, strict=True))
    if len(nodes) == 0:
        raise ValueError(
            f"{record.name}: expected clusters of {len(RULES)} classes, found none in {len(points)} points"
        )
    largest = np.sort(np.argsort(-counts, kind="stable")[:NODES])
    return np.pad(nodes[largest], ((0, NODES - len(largest)), (0, 0)))


def _nodes(
    points: Float32[np.ndarray, "n 3"], column: int, rule: Rule
) -> tuple[Int[np.ndarray, " k"], Float32[np.ndarray, "k 15"]]:
    """Return the numbers of points and the nodes of the clusters of one class."""
    cluster = clusters(points, rule.gap_m)
    counts = np.bincount(cluster)
    sums = [np.bincount(cluster, weights=axis) for axis in points.T.astype(np.float64)]
    kept = (counts >= rule.points) & (counts <= MOST_POINTS)
    centres = np.stack(sums, axis=1)[kept] / counts[kept, None]
    kinds = np.broadcast_to(np.eye(len(RULES))[column], (len(centres), len(RULES)))
    return counts[kept], np.concatenate([centres, kinds], axis=1).astype(np.float32)


def clusters(points: Float[np.ndarray, "n 3"], gap_m: float) -> Int[np.ndarray, " n"]:
    """Return the number of the cluster of each point. Neighbouring points of a cluster are at most `gap_m` apart.

    The points of a voxel of `gap_m` / 4 count as one point, their mean.
    """
    if len(points) == 0:
        return np.zeros(0, np.int64)
    voxel, counts = voxels(points, gap_m / FINER)
    means = np.stack([np.bincount(voxel, weights=axis) for axis in points.T], axis=1) / counts[:, None]
    pairs = KDTree(means).query_pairs(gap_m, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(means), len(means)))
    return connected_components(links, directed=False)[1][voxel].astype(np.int64)
