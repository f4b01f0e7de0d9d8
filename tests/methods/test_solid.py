import math
from collections import defaultdict

import numpy as np

from sglpr_jax.methods.handcrafted.solid import solid


def in_loops(points):
    """SOLiD's range part from its definition, point by point."""
    voxels = defaultdict(list)
    for point in points.astype(np.float64):
        if 3 <= math.sqrt(np.sum(point**2)) <= 80:
            voxels[tuple(np.floor(point.astype(np.float32) / np.float32(0.4)).astype(int))].append(point)
    counts = np.zeros((40, 32))
    for members in voxels.values():
        x, y, z = np.mean(members, axis=0)
        radius = math.hypot(x, y)
        elevation = math.floor((math.degrees(math.atan2(z, radius)) + 24.8) / 26.8 * 32)
        counts[min(int(radius / 2), 39), min(max(elevation, 0), 31)] += 1
    number = counts.sum(axis=0)
    weighted = counts @ ((number - number.min()) / (number.max() - number.min()))
    return weighted / np.linalg.norm(weighted)


def test_the_descriptor_is_the_weighted_count_of_each_range(places):
    rng = np.random.default_rng(0)
    wide = np.column_stack([rng.normal(0, 25, (2000, 2)), rng.normal(0, 2, 2000)]).astype(np.float32)
    for points in (places[0][0], wide):
        np.testing.assert_allclose(solid(points), in_loops(points), atol=1e-6)


def test_points_at_a_busy_elevation_count_more():
    low = [(10.0 + 0.5 * i, 0.0, -(10.0 + 0.5 * i) * 0.2) for i in range(4)]  # one elevation, 10 to 12 m
    high = [(30.0, 0.0, 0.5), (50.0, 0.0, -3.0)]  # elevations of their own
    found = solid(np.array(low + high, np.float32))
    assert found[5] > 0.9 and 0 < found[15] < found[5] / 4
