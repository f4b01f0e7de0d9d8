"""Corrupted sequences: labels stay with their points, and a scan's corruption is a function of seed and row."""

import numpy as np
import pytest
from recordings import with_points

from sglpr_jax.data.corruption import CORRUPTIONS, ROTATION, Corruption, corrupted
from sglpr_jax.data.readers import open_recording

ON_POINTS = [corruption for corruption in CORRUPTIONS if corruption != ROTATION]
by_name = pytest.mark.parametrize("corruption", ON_POINTS, ids=lambda corruption: corruption.name)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Four scans of 64 rings of 30 points in KITTI's layout, each point with a label of its own."""
    root = tmp_path_factory.mktemp("rings")
    folder = root / "sequences" / "00"
    for part in ("velodyne", "labels"):
        (folder / part).mkdir(parents=True)
    elevation, azimuth = np.radians(np.linspace(2, -24, 64)), np.arange(0.05, 2 * np.pi, 2 * np.pi / 30)
    ray = [np.outer(np.cos(elevation), axis(azimuth)).ravel() for axis in (np.cos, np.sin)]
    ray = np.stack([*ray, np.repeat(np.sin(elevation), 30)], axis=1)
    for scan in range(4):
        points = ray * np.random.default_rng(scan).uniform(5, 50, (len(ray), 1))
        np.pad(points, ((0, 0), (0, 1))).astype("<f4").tofile(folder / "velodyne" / f"{scan:06d}.bin")
        np.arange(len(ray), dtype="<u4").tofile(folder / "labels" / f"{scan:06d}.label")
    np.savetxt(folder / "poses.txt", np.tile(np.eye(3, 4).ravel(), (4, 1)))
    return open_recording(root, "00")


@by_name
def test_labels_stay_with_their_points(recording, corruption):
    points, labels = recording.points(1), recording.labels(1)
    found = corrupted(recording, corruption, seed=3)
    left, kept = found.points(1), found.labels(1)
    assert len(left) == len(kept)
    assert not np.array_equal(left, points)
    if len(left) < len(points):
        np.testing.assert_array_equal(left, points[kept])  # a label is its point's row
    else:
        np.testing.assert_array_equal(kept, labels)


@by_name
def test_a_scan_is_corrupted_by_seed_and_row_alone(recording, corruption):
    first = corrupted(recording, corruption, seed=3)
    forwards = [first.points(i) for i in range(4)]
    again = corrupted(recording, corruption, seed=3)
    for i in reversed(range(4)):
        np.testing.assert_array_equal(again.points(i), forwards[i])
    if corruption.kind in ("occlusion", "noise", "dropout"):
        assert not np.array_equal(corrupted(recording, corruption, seed=4).points(0), forwards[0])


def test_each_scan_has_a_draw_of_its_own(recording):
    twice = with_points(recording, lambda path: recording.points(0))
    found = corrupted(twice, Corruption("dropout", 0.5), seed=0)
    assert not np.array_equal(found.points(0), found.points(1))


def test_all_but_the_points_stays(recording):
    found = corrupted(recording, Corruption("offset", 1.0), seed=0)
    assert (found.name, found.ids, len(found), found.has_labels) == (recording.name, recording.ids, 4, True)
    np.testing.assert_array_equal(found.positions, recording.positions)
    assert found.pose_source == "sequences/00/poses.txt"


def test_points_that_are_not_finite_go_with_their_labels(kitti_root):
    path = kitti_root / "sequences" / "08" / "velodyne" / "000000.bin"
    records = np.fromfile(path, "<f4").reshape(-1, 4)
    records[1, 2] = np.nan
    records.tofile(path)
    found = corrupted(open_recording(kitti_root, "08"), Corruption("offset", 1.0), seed=0)
    assert np.isfinite(found.points(0)).all()
    np.testing.assert_array_equal(found.labels(0), [48, 50, 51, 52])
    assert found.labels(1) is None


def test_lasers_named_by_the_file_are_used(tmp_path):
    points = np.random.default_rng(0).normal(scale=10, size=(400, 5)).astype("<f4")
    points[:, 4] = np.arange(400) % 32
    points[5, 0] = np.nan
    points.tofile(tmp_path / "0.bin")
    found = corrupted(open_recording(tmp_path, format="nuscenes"), Corruption("beams", 16.0), seed=0)
    expected = (400 / 32) * 16
    assert expected - 25 < len(found.points(0)) < expected + 25


def test_a_scan_without_rings_is_named(tmp_path):
    np.random.default_rng(0).normal(scale=10, size=(4000, 4)).astype("<f4").tofile(tmp_path / "000007.bin")
    found = corrupted(open_recording(tmp_path, format="kitti"), Corruption("beams", 16.0), seed=0)
    with pytest.raises(ValueError, match=r"scan 000007 of sequence .*: beams-16: expected a scan with rings"):
        found.points(0)


def test_images_have_no_points(bev_root):
    with pytest.raises(ValueError, match=r"beams-16 needs points, found only images in sequence 06.*rotation"):
        corrupted(open_recording(bev_root, "06"), Corruption("beams", 16.0), seed=0)
