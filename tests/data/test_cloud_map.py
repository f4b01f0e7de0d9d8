"""A point cloud map with the trajectory of its LiDAR: trails are removed, and scans are computed at the poses."""

import numpy as np
import pytest
from clouds import pcd, records_of
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sglpr_jax.data.cloud_map import BEHIND_M, NEAREST_M, TILE_M, on_trail, remove_hidden_points, tiled_cloud
from sglpr_jax.data.fingerprint import fingerprint
from sglpr_jax.data.readers import cloud_map, open_recording
from sglpr_jax.data.readers.cloud_map import REACH_M
from sglpr_jax.files import DataWarning


def plane(x, y, step=0.1):
    """Ground at z = 0 over two ranges of coordinates."""
    x, y = np.meshgrid(np.arange(*x, step), np.arange(*y, step))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def sheet(x, z, y=0.05):
    """Vertical sheet along x, such as the side of a car or a facade."""
    x, z = np.meshgrid(np.arange(*x, 0.1), np.arange(*z, 0.1))
    return np.stack([x.ravel(), np.full(x.size, y), z.ravel()], axis=1)


STREET = plane((-5, 5), (-5, 5))


@pytest.mark.parametrize(
    ("ground", "thing", "moved"),
    [
        (STREET, sheet((-2, 2), (0.4, 1.5)), True),
        (STREET, sheet((0, 0.3), (0, 1.8)), True),  # a pedestrian
        (STREET, sheet((-2, 2), (0.4, 4.0)), False),  # a lorry or a wall
        (STREET, sheet((0, 0.3), (0, 6.0)), False),  # a trunk
        (STREET, sheet((-2, 2), (2.5, 4.0)), False),  # a crown
        (plane((-5, 5), (-5, 0)), sheet((-4, 4), (0, 2.0)), False),  # nothing was seen behind it
        (STREET[np.abs(STREET).max(axis=1) > 1], sheet((-0.9, 0.9), (0.2, 1.5)), False),  # it stayed
    ],
)
def test_low_objects_on_visible_ground_are_removed(ground, thing, moved):
    points = np.concatenate([ground, thing]).astype(np.float32)
    found = on_trail(points)
    assert not found[: len(ground)].any()
    assert found[len(ground) :].mean() > 0.75 if moved else not found.any()


SPACING_M = 0.1
CLOUDS = arrays(np.float32, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(-30, 30, width=16))


def seen(points, **options):
    return remove_hidden_points(points, **{"spacing_m": SPACING_M, "reach_m": 36.0, **options})


def as_rows(points):
    return {tuple(row) for row in points.tolist()}


def test_hidden_points_agree_with_a_plain_loop():
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
    found = as_rows(seen(points, spacing_m=0.5))
    assert found == as_rows(points[kept])


@settings(max_examples=30, deadline=None)
@given(CLOUDS, st.randoms(use_true_random=False))
def test_points_are_of_the_cloud_and_their_order_does_not_matter(points, random):
    found = seen(points)
    assert as_rows(found) <= as_rows(points)
    ranges = np.linalg.norm(found, axis=1)
    assert ((ranges > NEAREST_M - 1e-3) & (ranges < 36.001)).all()
    order = list(range(len(points)))
    random.shuffle(order)
    assert as_rows(seen(points[order])) == as_rows(found)


HEIGHT_M = 1.5
ORIGIN = np.array([1000.0, -2000.0, 40.0])
"""Where the street begins, as in a frame with large coordinates."""


def street():
    """Ground along x, a house on the left, and a wall behind it that no place of the street shows."""
    x, y = np.meshgrid(np.arange(-40, 80, 0.2), np.arange(-12, 12, 0.2))
    ground = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    x, z = np.meshgrid(np.arange(-40, 80, 0.2), np.arange(0, 8, 0.2))
    house = np.stack([x.ravel(), np.full(x.size, 8.0), z.ravel()], axis=1)
    return np.concatenate([ground, house, house + np.array([0, 4, 0])]) + ORIGIN


def write_map(path, points):
    path.write_bytes(pcd(records_of(points, "x:f8 y:f8 z:f8")))
    return path


def write_tum(path, positions, quaternion=(0, 0, 0, 1)):
    rows = [[0.5 + 0.1 * i, *position, *quaternion] for i, position in enumerate(positions)]
    np.savetxt(path, rows, fmt="%.6f")
    return path


def along(count=5, height_m=HEIGHT_M, start=ORIGIN):
    return start + np.stack([np.arange(count) * 5.0, np.zeros(count), np.full(count, height_m)], axis=1)


def test_other_rotations_are_another_recording(tmp_path):
    town, way = write_map(tmp_path / "town.pcd", street()), tmp_path / "way.tum"
    found = {
        fingerprint(open_recording(town, poses=write_tum(way, along(), turn), sensor_height=1.5), contents="all")
        for turn in ((0, 0, 0, 1), (0, 0, 1, 0))
    }
    assert len(found) == 2


@pytest.fixture
def opened(tmp_path):
    town = write_map(tmp_path / "town.pcd", street())
    way = tmp_path / "way.tum"
    return lambda positions, **options: open_recording(town, poses=write_tum(way, positions, **options))


def test_a_scan_has_the_visible_points_around_its_pose(opened):
    recording = opened(along())
    assert (recording.name, recording.ids[2], len(recording)) == ("town", "000002", 5)
    np.testing.assert_allclose(recording.world_from_lidar[:, :3, 3], along())
    assert recording.mounting.height_m == pytest.approx(HEIGHT_M, abs=0.02)
    assert "point cloud map town.pcd" in recording.description[1]
    points = recording.points(2)
    assert len(points) > 1000 and np.linalg.norm(points, axis=1).max() <= REACH_M
    house, behind = (points[np.abs(points[:, 1] - y) < 0.01] for y in (8, 12))
    assert len(behind) < 0.35 * len(house), "the house hides most of the wall behind it"
    assert np.ptp(house[:, 0]) > 60
    left = opened(along(3), quaternion=(0, 0, np.sqrt(0.5), np.sqrt(0.5))).points(1)  # turned by 90 degrees
    assert left[:, 0].max() == pytest.approx(points[:, 1].max(), abs=1e-2)


def test_a_tiled_cloud_has_one_point_per_voxel_near_the_trajectory(tmp_path):
    rng = np.random.default_rng(5)
    cloud = rng.uniform([-150, -150, -3], [150, 150, 3], (40_000, 3))
    positions = np.array([[0.0, 0, 0], [60, 0, 0]])
    found = tiled_cloud(np.array_split(cloud, 7), positions=positions, reach_m=30.0, source=tmp_path)
    assert found.total == len(cloud)
    np.testing.assert_array_equal((found.lowest, found.highest), (cloud.min(axis=0), cloud.max(axis=0)))
    everything = {tuple(row) for row in cloud.astype(np.float32).tolist()}
    assert {tuple(row) for row in found.points.tolist()} <= everything
    voxels = np.floor(found.points.astype(float) / 0.1)
    assert len(np.unique(voxels, axis=0)) == len(voxels)
    for position in positions:
        near = found.near(position, 30.0)
        assert np.abs(near[:, :2]).max() <= 30 + TILE_M
        inside = np.abs(cloud[:, :2] - position[:2]).max(axis=1) <= 30
        expected = np.unique(np.floor(cloud[inside].astype(np.float32).astype(float) / 0.1), axis=0)
        assert np.count_nonzero(np.abs(near[:, :2]).max(axis=1) <= 30) == pytest.approx(len(expected), abs=2)


def test_a_map_needs_poses_in_its_frame(opened, tmp_path):
    with pytest.raises(ValueError, match=r"town\.pcd: expected a point cloud map with the poses .*found no poses"):
        open_recording(tmp_path / "town.pcd")
    for start in (np.zeros(3), ORIGIN + np.array([0, 0, 200])):
        message = r"way\.tum: expected poses in the frame of town\.pcd, which covers x 960 to 1080 m, .* found poses at"
        with pytest.raises(ValueError, match=message):
            opened(along(start=start))


def test_poses_without_points_are_left_out(opened):
    positions = np.concatenate([along(3), along(2, start=ORIGIN + np.array([500, 0, 0]))])
    with pytest.warns(DataWarning, match=r"expected points .* found none at 2 of 5 poses, .*in row 4 at \(1500"):
        recording = opened(positions)
    assert recording.ids == ("000000", "000001", "000002") and len(recording.points(2))


def test_poses_of_the_base_are_raised(opened):
    with pytest.warns(DataWarning, match=r"expected poses of the LiDAR, found poses 0\.0\d m above the ground"):
        recording = opened(along(height_m=0.05))
    np.testing.assert_allclose(recording.world_from_lidar[:, 2, 3], ORIGIN[2] + 1.73, atol=0.03)
    assert recording.mounting.height_m == pytest.approx(1.73, abs=0.03)


def test_damaged_and_too_large_maps(tmp_path, monkeypatch):
    path = tmp_path / "town.pcd"
    write_map(path, street()).write_bytes(path.read_bytes()[:-1])
    way = write_tum(tmp_path / "way.tum", along())
    with pytest.raises(ValueError, match=r"town\.pcd: expected a readable \.pcd file.*points of 24 bytes, found"):
        open_recording(path, poses=way)
    monkeypatch.setattr("sglpr_jax.data.cloud_map.MOST_POINTS", 100)
    with pytest.raises(ValueError, match=r"town\.pcd: expected at most 100 points in voxels of 0\.1 m .*cut the cloud"):
        open_recording(write_map(path, street()), poses=way)
    write_map(path, np.full((3, 3), np.nan))
    with pytest.raises(ValueError, match=r"town\.pcd: expected finite points, found none"):
        open_recording(path, poses=way)
    assert cloud_map.recording_names(tmp_path) == ()
