"""Disturbed sequences: labels stay with their points, and a scan's disturbance is a function of seed and row."""

import dataclasses

import numpy as np
import pytest

from sglpr_jax.data import open_sequence
from sglpr_jax.data.disturbances import DISTURBANCES, ROTATION, Disturbance
from sglpr_jax.data.disturbed import disturbed

ON_POINTS = [disturbance for disturbance in DISTURBANCES if disturbance != ROTATION]
by_name = pytest.mark.parametrize("disturbance", ON_POINTS, ids=lambda disturbance: disturbance.name)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
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
    return open_sequence(root, "00")


@by_name
def test_labels_stay_with_their_points(drive, disturbance):
    points, labels = drive.points(1), drive.labels(1)
    found = disturbed(drive, disturbance, seed=3)
    left, kept = found.points(1), found.labels(1)
    assert len(left) == len(kept)
    assert (len(left) == len(points)) == (disturbance.kind in ("noise", "offset"))
    assert not np.array_equal(left, points)
    if disturbance.kind in ("occlusion", "beams", "dropout"):
        np.testing.assert_array_equal(left, points[kept])  # a label is its point's row
    else:
        np.testing.assert_array_equal(kept, labels)


@by_name
def test_a_scan_is_disturbed_by_seed_and_row_alone(drive, disturbance):
    first = disturbed(drive, disturbance, seed=3)
    forwards = [first.points(i) for i in range(4)]
    again = disturbed(drive, disturbance, seed=3)
    for i in reversed(range(4)):
        np.testing.assert_array_equal(again.points(i), forwards[i])
    if disturbance.kind in ("occlusion", "noise", "dropout"):
        assert not np.array_equal(disturbed(drive, disturbance, seed=4).points(0), forwards[0])


def test_each_scan_has_a_draw_of_its_own(drive):
    twice = dataclasses.replace(drive, read_scan=lambda path: drive.points(0))
    found = disturbed(twice, Disturbance("dropout", 0.5), seed=0)
    assert not np.array_equal(found.points(0), found.points(1))


def test_all_but_the_points_stays(drive):
    found = disturbed(drive, Disturbance("offset", 1.0), seed=0)
    assert (found.name, found.ids, len(found), found.has_labels) == (drive.name, drive.ids, 4, True)
    np.testing.assert_array_equal(found.positions, drive.positions)
    assert found.pose_source == "sequences/00/poses.txt"


def test_points_that_are_not_finite_go_with_their_labels(kitti_root):
    path = kitti_root / "sequences" / "08" / "velodyne" / "000000.bin"
    records = np.fromfile(path, "<f4").reshape(-1, 4)
    records[1, 2] = np.nan
    records.tofile(path)
    found = disturbed(open_sequence(kitti_root, "08"), Disturbance("offset", 1.0), seed=0)
    assert np.isfinite(found.points(0)).all()
    np.testing.assert_array_equal(found.labels(0), [48, 50, 51, 52])
    assert found.labels(1) is None


def test_lasers_named_by_the_file_are_used(tmp_path):
    points = np.random.default_rng(0).normal(scale=10, size=(400, 5)).astype("<f4")
    points[:, 4] = np.arange(400) % 32
    points[5, 0] = np.nan
    points.tofile(tmp_path / "0.bin")
    found = disturbed(open_sequence(tmp_path, format="nuscenes"), Disturbance("beams", 16.0), seed=0)
    expected = (400 / 32) * 16
    assert expected - 25 < len(found.points(0)) < expected + 25


def test_a_scan_without_rings_is_named(tmp_path):
    np.random.default_rng(0).normal(scale=10, size=(4000, 4)).astype("<f4").tofile(tmp_path / "000007.bin")
    found = disturbed(open_sequence(tmp_path), Disturbance("beams", 16.0), seed=0)
    with pytest.raises(ValueError, match=r"scan 000007 of sequence .*: beams-16: expected a scan with rings"):
        found.points(0)


def test_images_have_no_points(bev_root):
    with pytest.raises(ValueError, match=r"beams-16 needs points, found only images in sequence 06.*rotation"):
        disturbed(open_sequence(bev_root, "06"), Disturbance("beams", 16.0), seed=0)
