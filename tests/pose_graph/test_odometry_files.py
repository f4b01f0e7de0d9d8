"""Odometry of every format is the same poses; what is none is one clear error."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from recordings import of_scans

from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.pose_graph.files import write_g2o, write_kitti, write_tum
from sglpr_jax.pose_graph.odometry_files import match_to_scans, read_odometry, read_stamped
from sglpr_jax.se3 import transform


@pytest.fixture
def poses() -> np.ndarray:
    return np.stack([transform(x, 0.1 * x, 0.3 * x) for x in np.arange(5.0)])


def test_every_format_gives_the_same_poses(tmp_path, poses):
    write_kitti(tmp_path / "kitti.txt", poses)
    write_tum(tmp_path / "tum.txt", poses, np.arange(5.0))
    write_g2o(tmp_path / "graph.g2o", [], [(np.arange(5), poses, DriftModel())])
    np.savetxt(tmp_path / "lidar.txt", poses[:, :3].reshape(5, 12))
    for name, format in (("kitti", "kitti"), ("tum", "auto"), ("tum", "tum"), ("lidar", "lidar")):
        np.testing.assert_allclose(read_odometry(tmp_path / f"{name}.txt", format=format), poses, atol=1e-6)
    np.testing.assert_allclose(read_odometry(tmp_path / "graph.g2o"), poses, atol=1e-6)


def test_a_tum_file_of_other_times_is_interpolated_at_the_scans(tmp_path, poses):
    times = np.array([-0.5, 0.5, 1.25, 4.0, 4.05, 6.0])
    clouds = {Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(len(times))}
    recording = of_scans(clouds, times=times, positions=np.arange(18.0).reshape(6, 3))
    path = tmp_path / "odometry.tum"
    write_tum(path, poses, np.arange(5.0))
    found, given = match_to_scans(recording, *read_stamped(path, time_unit="s"), path)
    assert found.ids == ("1", "2", "3", "4") and found.numbers.tolist() == [1, 2, 3, 4]
    np.testing.assert_array_equal(found.positions, recording.positions[1:5])
    at = np.array([0.5, 1.25, 4.0, 4.0])
    between = np.stack([transform(x, 0.1 * x, 0.3 * x) for x in at])
    np.testing.assert_allclose(given, between, atol=1e-6)
    assert found.found == (
        "odometry: 5 poses of odometry.tum, interpolated at the times of the scans; 2 of 6 scans left out, which have "
        "no pose",
    )
    late = dataclasses.replace(recording, times=times + 3)
    message = r"odometry\.tum: expected 6 poses, one for each scan of 08.* 2\.5 to 9\.0 s, found 5 from 0\.0 to"
    with pytest.raises(ValueError, match=message):
        match_to_scans(late, *read_stamped(path, format="tum", time_unit="s"), path)
    with pytest.raises(ValueError, match=r"found 5, and the file has no times .*row numbers 0, 1, 2"):
        match_to_scans(recording, *read_stamped(path), path)


@pytest.mark.parametrize(("stamps", "by_row"), [(5e-4, True), (0.02, False), ("numbers", True)])
def test_as_many_poses_as_scans_go_row_by_row_only_where_their_times_are_the_same(tmp_path, poses, stamps, by_row):
    """0, 1, 2, ... are numbers of rows and no times."""
    times = 7 + 0.9 * np.arange(5)
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(5)}, times=times)
    path = tmp_path / "odometry.tum"
    write_tum(path, poses, np.arange(5.0) if stamps == "numbers" else times + stamps)
    found, given = match_to_scans(recording, poses, read_stamped(path)[1], path)
    assert len(found) == 5 and (found is recording and given is poses) == by_row
    np.testing.assert_allclose(given[1:, 0, 3], poses[1:, 0, 3] - (0 if by_row else 0.02 / 0.9), atol=1e-3)


def test_as_many_poses_of_another_clock_are_told_and_of_other_steps_refused(tmp_path, poses):
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(5)}, times=np.arange(5.0))
    path = tmp_path / "odometry.tum"
    write_tum(path, poses, 1.6e9 + np.arange(5.0))
    found, given = match_to_scans(recording, poses, read_stamped(path)[1], path)
    assert given is poses and len(found) == 5
    said = "row by row: the scans have the same intervals and start -1600000000.0 s later"
    assert found.found == (f"odometry: 5 poses of odometry.tum, {said}",)
    write_tum(path, poses, 1.6e9 + 1.1 * np.arange(5.0))
    message = (
        r"odometry\.tum: expected 5 poses.*0\.0 to 4\.0 s, found 5 from 1600000000\.0 to .*write 12 numbers a line"
    )
    with pytest.raises(ValueError, match=message):
        match_to_scans(recording, poses, read_stamped(path)[1], path)


def test_scans_without_times_get_those_of_a_tum_file(tmp_path, poses):
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(5)}, times=None)
    write_tum(tmp_path / "odometry.tum", poses, 1.6e9 + np.arange(5.0))
    write_kitti(tmp_path / "kitti.txt", poses)
    found, given = match_to_scans(recording, poses, np.arange(5.0) + 1.6e9, tmp_path / "odometry.tum")
    np.testing.assert_array_equal(found.times, 1.6e9 + np.arange(5.0))
    assert given is poses and found.found[-1] == "times: from odometry.tum"
    assert match_to_scans(recording, poses, None, tmp_path / "kitti.txt")[0] is recording


@pytest.mark.parametrize(
    ("text", "format", "message"),
    [
        ("", "auto", "found an empty file"),
        ("1 2 3\n", "auto", "found 3 numbers a line"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", "auto", "found 12 numbers a line; for 12 numbers a line, name the axes"),
        ("2 0 0 0 0 2 0 0 0 0 2 0\n", "lidar", "expected a rotation and a translation in row 1"),
        ("VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1\n", "g2o", "expected vertices 0, 1, 2"),
    ],
)
def test_what_is_no_odometry_is_one_clear_error(tmp_path, text, format, message):
    path = tmp_path / "poses.txt"
    with pytest.raises(FileNotFoundError, match=r"poses\.txt"):
        read_odometry(path, format=format)
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"poses\.txt.*{message}"):
        read_odometry(path, format=format)
