"""Which points of a cloud a LiDAR sees: those in front of walls, one for each ray."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sglpr_jax.data.cloud_map import BEHIND_M, NEAREST_M, RAY_DEG, visible_points

SPACING_M = 0.1
CLOUDS = arrays(np.float32, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(-30, 30, width=16))


def wall(x, *, half_m=4.0, spacing=SPACING_M / 2):
    """Points of a square wall across the x axis."""
    y, z = np.meshgrid(*[np.arange(-half_m, half_m, spacing)] * 2)
    return np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1).astype(np.float32)


def seen(points, **options):
    return visible_points(points, **{"spacing_m": SPACING_M, "reach_m": 36.0, **options})


def rows_of(points):
    return {tuple(row) for row in points.tolist()}


@pytest.mark.slow
def test_a_wall_hides_almost_all_points_behind_it_and_none_beside_it():
    for near_m in (2.0, 5.0, 10.0):
        behind = wall(near_m + 8, half_m=0.8 * 4 * (near_m + 8) / near_m)
        beside = wall(15.0, half_m=2) + np.float32([0, 40 / near_m + 60 / near_m, 0])
        beside = beside[np.linalg.norm(beside, axis=1) < 36]
        found = rows_of(seen(np.concatenate([wall(near_m), behind, beside])))
        assert len(found & rows_of(behind)) < 0.03 * len(seen(behind)), "the wall has almost no holes"
        assert found & rows_of(wall(near_m))
        assert rows_of(seen(beside)) <= found


def test_a_surface_at_a_grazing_angle_does_not_hide_itself():
    facade = wall(0.0, half_m=20)[:, [1, 0, 2]] + np.float32([0, 6, 0])
    alone = facade[np.abs(facade[:, 2]) < 3]
    along = seen(alone)[:, 0]
    expected = np.arange(-19.5, 19.5)
    assert np.isin(np.floor(expected), np.floor(along)).all(), "some points of each metre of the facade"


def test_each_ray_returns_its_nearest_point():
    steps = np.radians(np.array(RAY_DEG))
    directions = np.array([[1, steps[0] / 4, steps[1] / 4], [1, steps[0] / 3, steps[1] / 3]], np.float32)
    pair = directions * np.float32([[10.0], [10.1]])
    np.testing.assert_array_equal(seen(pair), pair[:1])
    np.testing.assert_array_equal(seen(pair[::-1]), pair[:1])


def test_agreement_with_a_plain_loop():
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = (directions * rng.uniform(1, 30, (400, 1))).astype(np.float32)
    ranges = np.linalg.norm(points, axis=1)
    needed = np.degrees(0.5 * 0.5 / ranges)
    level = np.ceil(np.log2(needed / 0.25).clip(0, 7)).astype(int)  # cells of 0.25, 0.5, 1, ..., 32 degrees
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    elevation = np.degrees(np.arcsin(points[:, 2] / ranges)) + 90
    kept = []
    for i in range(400):
        edges = 0.25 * 2.0**level
        same = (azimuth[i] // edges == azimuth // edges) & (elevation[i] // edges == elevation // edges)
        nearest = {k: ranges[same & (level == k)].min() for k in set(level[same])}
        if not any(ranges[i] > at + BEHIND_M + 3 * np.radians(0.25 * 2.0**k) * at for k, at in nearest.items()):
            kept.append(i)
    found = rows_of(seen(points, spacing_m=0.5))
    assert found == rows_of(points[kept])


@settings(max_examples=30, deadline=None)
@given(CLOUDS, st.randoms(use_true_random=False))
def test_points_are_of_the_cloud_and_their_order_does_not_matter(points, random):
    found = seen(points)
    assert rows_of(found) <= rows_of(points)
    ranges = np.linalg.norm(found, axis=1)
    assert ((ranges > NEAREST_M - 1e-3) & (ranges < 36.001)).all()
    order = list(range(len(points)))
    random.shuffle(order)
    assert rows_of(seen(points[order])) == rows_of(found)


def test_a_turn_about_the_vertical_turns_the_visible_points():
    """Quarter turns are exact and map cells to cells."""
    rng = np.random.default_rng(0)
    cloud = np.concatenate([wall(8.0), rng.uniform(-30, 30, (5000, 3)).astype(np.float32)])
    turned = cloud[:, [1, 0, 2]] * np.float32([-1, 1, 1])
    expected = seen(cloud)[:, [1, 0, 2]] * np.float32([-1, 1, 1])
    shared = rows_of(seen(turned)) & rows_of(expected)
    assert len(shared) > 0.999 * len(expected)  # the angles of points on the edge of a cell are rounded


def test_nothing_is_seen_in_an_empty_cloud():
    assert seen(np.zeros((0, 3), np.float32)).shape == (0, 3)
