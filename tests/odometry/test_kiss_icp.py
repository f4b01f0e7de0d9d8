"""Odometry from the scans of a simulated street, and warnings about scans that do not overlap or have few points."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from recordings import of_images, of_scans, with_points
from scipy.spatial.transform import Rotation

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan, TimeField
from sglpr_jax.data.scan_stream import only
from sglpr_jax.files import DataWarning
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.odometry import kiss_icp
from sglpr_jax.odometry.config import OdometryConfig
from sglpr_jax.pose_graph.optimize import trajectory_error
from sglpr_jax.pose_graph.slam import slam
from sglpr_jax.se3 import inverse

SCANS = 30
ELSEWHERE = (150, 151)


@pytest.fixture(scope="module")
def street(drive) -> Recording:
    """30 scans of a street, 1.8 m apart, and two of another street."""
    rows = (*range(SCANS), *ELSEWHERE)
    clouds = {Path(drive.ids[row]): drive.points(row) for row in rows}
    return of_scans(clouds, name="street", positions=drive.positions[list(rows)], times=drive.times[list(rows)])


@pytest.fixture(scope="module")
def start(street) -> Recording:
    """The first scans of the street."""
    return only(street, range(12))


def test_poses_follow_the_street(street):
    recording, done = only(street, range(SCANS)), []
    poses = kiss_icp.scan_odometry(recording, on_progress=done.append)
    assert recording.positions is not None
    assert trajectory_error(poses, recording.positions) < 0.15 and np.ptp(recording.positions, axis=0).max() > 50
    np.testing.assert_array_equal(poses[0], np.eye(4))
    assert done == list(range(1, SCANS + 1))


def test_a_pause_of_the_recorder_is_bridged(street):
    apart = only(street, (*range(8), *range(12, 22)))
    assert trajectory_error(kiss_icp.scan_odometry(apart), np.asarray(apart.positions)) < 0.3


def test_a_stopped_run_resumes_with_the_same_poses(start, tmp_path, monkeypatch):
    kept, done, aligned = tmp_path / "kept.log", [], []
    options = {"kept_in": kept, "on_progress": done.append}
    part = kiss_icp.scan_odometry(start, should_stop=lambda: len(done) == 7, **options)
    assert len(part) == 7 and kept.exists()
    add = kiss_icp._FrontEnd.add

    def counted(self, row, cloud, *, known_pose=None):
        aligned.extend([1] if known_pose is None else [])
        return add(self, row, cloud, known_pose=known_pose)

    monkeypatch.setattr(kiss_icp._FrontEnd, "add", counted)
    whole = kiss_icp.scan_odometry(start, **options)
    np.testing.assert_array_equal(whole[:7], part)
    assert len(aligned) == 5
    np.testing.assert_allclose(whole, kiss_icp.scan_odometry(start), atol=1e-6)  # sums of threads in any order
    np.testing.assert_array_equal(kiss_icp.scan_odometry(start, **options), whole)
    assert len(aligned) == 5 + 12


def test_a_checkpoint_of_something_else_is_not_used(start, tmp_path):
    few, kept = only(start, range(3)), tmp_path / "kept.log"
    kiss_icp.scan_odometry(few, kept_in=kept)
    with pytest.warns(DataWarning, match=r"kept.log: expected .* same settings, found another max_range_m; restarting"):
        kiss_icp.scan_odometry(few, kept_in=kept, config=OdometryConfig(max_range_m=60.0))


def test_scans_that_do_not_overlap_are_named(street, tmp_path):
    rows = (*range(8), SCANS, SCANS + 1)
    said = r"street: expected scans that overlap the previous ones, found 1 that do not, first scan 000150 \(\d+%\)"
    for _ in range(2):  # the second time by the checkpoint
        with pytest.warns(DataWarning, match=said):
            assert len(kiss_icp.scan_odometry(only(street, rows), kept_in=tmp_path / "kept.log")) == len(rows)


def test_poses_of_scans_with_few_points_are_extrapolated(start, tmp_path):
    blocked = start.paths[8]
    half = with_points(start, lambda path: start.points(start.paths.index(path))[:: 2000 if path == blocked else 1])
    with pytest.warns(DataWarning, match=r"100 points or more in each scan, found fewer in 1, first in scan 000008;"):
        poses = kiss_icp.scan_odometry(half)
    np.testing.assert_allclose(inverse(poses[7]) @ poses[8], inverse(poses[6]) @ poses[7], atol=1e-9)
    assert trajectory_error(poses, np.asarray(start.positions)) < 0.15
    none = with_points(start, lambda path: start.points(0)[:50])
    said = r"street: expected scans with 100 points or more for odometry, found at most \d+ after"
    for _ in range(2):  # the second time by the checkpoint
        with pytest.raises(ValueError, match=said):
            kiss_icp.scan_odometry(none, kept_in=tmp_path / "kept.log")


def test_unreadable_scans_are_skipped_or_an_error(start):
    def points(path):
        if path == start.paths[5]:
            raise ValueError("broken")
        return start.points(start.paths.index(path))

    bad, broken = [], with_points(start, points)
    poses = kiss_icp.scan_odometry(broken, on_bad_scan=lambda scan, error: bad.append(scan))
    assert bad == ["000005"] and trajectory_error(poses, np.asarray(start.positions)) < 0.15
    with pytest.raises(ValueError, match="broken"):
        kiss_icp.scan_odometry(broken)


def test_scaled_scans_give_poses_in_metres(start):
    poses = kiss_icp.scan_odometry(start, scale=2)
    assert trajectory_error(poses, np.asarray(start.positions)) < 0.5
    assert (
        ", points up to 50 m, voxels of 0.5 m, motion within scans not removed: no valid times"
        in kiss_icp.describe_odometry(start, OdometryConfig(), scale=2)
    )


def test_the_motion_within_scans_is_removed():
    """An accelerating, turning sensor between walls: poses are those at the times of the scans, the first points."""
    rng, times, clouds, stamps = np.random.default_rng(0), 0.1 * np.arange(16), {}, np.linspace(0, 0.1, 6000)
    walls = rng.uniform([-30, -20, -1.5], [60, 20, 4], (20_000, 3))
    walls[::2, 1] = np.sign(walls[::2, 1]) * rng.choice([8, 12, 15], 10_000)
    for row, time in enumerate(times):
        x, turned = 3 * (time + stamps) ** 2, 0.2 * (time + stamps) ** 2
        seen = rng.permutation(walls)[:6000] - np.stack([x, 0 * x, 0 * x], axis=1)
        rotations = Rotation.from_rotvec(np.outer(-turned, [0, 0, 1]))
        clouds[Path(f"{row:06d}")] = rotations.apply(seen).astype(np.float32)
    plain = of_scans(clouds, times=times)
    timed = dataclasses.replace(
        plain, read=lambda path, *_: Scan(points=clouds[path], time_field=TimeField("t", stamps))
    )
    still, moved = (kiss_icp.scan_odometry(one)[:, 0, 3] for one in (timed, plain))
    np.testing.assert_allclose(still, 3 * times**2, atol=0.06)
    thinned = kiss_icp.scan_odometry(only(timed, range(0, 16, 3)))[:, 0, 3]
    np.testing.assert_allclose(thinned, 3 * times[::3] ** 2, atol=0.15)
    assert moved[-1] - 3 * times[-1] ** 2 > 0.3
    assert kiss_icp.describe_odometry(timed, OdometryConfig(), scale=1).endswith("motion within scans removed")


def test_images_and_a_missing_library_are_clear_errors(start, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="08: expected scans for odometry, found ready-made images"):
        kiss_icp.scan_odometry(of_images({tmp_path / "0.png": np.zeros((4, 4), np.float32)}))
    with pytest.raises(ValueError, match=r"expected min_range_m < max_range_m = 5, found 6"):
        OdometryConfig(max_range_m=5.0, min_range_m=6.0)
    monkeypatch.setitem(sys.modules, "kiss_icp.kiss_icp", None)
    with pytest.raises(ImportError, match=r"kiss-icp: .* -m pip install .*kiss-icp"):
        kiss_icp.scan_odometry(start)


@pytest.mark.slow
def test_slam_goes_from_scans_to_a_trajectory(start, tmp_path):
    result = slam(start, config=DetectorConfig(), registered=False, kept_in=tmp_path)
    assert result.loops.whole and result.odometry.shape == result.trajectory.poses.shape == (12, 4, 4)
    np.testing.assert_array_equal(result.odometry, result.loops.sessions[0].odometry)
    assert str(result).endswith("trajectory not corrected: no loops")
    again = slam(start, registered=False, kept_in=tmp_path)
    np.testing.assert_array_equal(again.trajectory.poses, result.trajectory.poses)
