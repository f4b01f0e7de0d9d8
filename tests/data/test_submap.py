"""A submap holds the points of the last metres, where they belong, in bounded memory."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import of_scans
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from sglpr_jax.data.submap import SubmapBuilder, submaps
from sglpr_jax.files import DataWarning

WORLD = np.random.default_rng(0).uniform(-30, 30, (2000, 3)).astype(np.float32)
WORLD[:, 2] *= 0.1


def pose(x: float, yaw_deg: float = 0.0, roll_deg: float = 0.0) -> np.ndarray:
    found = np.eye(4)
    found[:3, :3] = Rotation.from_euler("zyx", [yaw_deg, 0.0, roll_deg], degrees=True).as_matrix()
    found[0, 3] = x
    return found


def seen_from(world_from_lidar: np.ndarray, reach_m: float = 10.0) -> np.ndarray:
    """The points of the world within reach of a sensor, in its frame."""
    points = (WORLD - world_from_lidar[:3, 3]) @ world_from_lidar[:3, :3]
    return points[np.linalg.norm(points, axis=1) < reach_m].astype(np.float32)


def drive(poses: np.ndarray, **fields):
    clouds = {Path(f"{i:03d}.bin"): seen_from(one) for i, one in enumerate(poses)}
    return of_scans(clouds, **fields), clouds


@settings(max_examples=20, deadline=None)
@given(
    st.lists(st.tuples(st.floats(0.0, 1.5), st.floats(-40, 40), st.floats(-5, 5)), min_size=2, max_size=12),
    st.sampled_from([3.0, 10.0]),
)
def test_points_lie_where_they_are_in_the_world_whatever_the_poses(steps, length_m):
    x, yaw, poses = 0.0, 0.0, []
    for step_m, turn_deg, roll_deg in steps:
        x, yaw = x + step_m, yaw + turn_deg
        poses.append(pose(x, yaw, roll_deg))
    recording, _ = drive(np.array(poses))
    found = submaps(recording, np.array(poses), length_m=length_m).points(len(poses) - 1)
    in_world = found @ poses[-1][:3, :3].T + poses[-1][:3, 3]
    assert KDTree(WORLD).query(in_world)[0].max() < 1e-3
    assert len(found) >= 0.8 * len(seen_from(poses[-1]))


def test_rays_without_an_echo_are_no_points_of_a_submap():
    builder = SubmapBuilder()
    builder.add(np.array([[0, 0, 0], [10, 0.1, 1]], np.float32), pose(0.0))
    found = builder.add(np.array([[0, 0, 0], [10, 2, 1]], np.float32), pose(1.5))
    np.testing.assert_allclose(found, [[10, 2, 1], [8.5, 0.1, 1]], atol=1e-6)


@pytest.mark.parametrize("length_m", [5.0, 0.5])
@pytest.mark.parametrize("steps", [range(40), [*range(18), 16, 17, 18, 17, *range(18, 36)]], ids=["on", "to and fro"])
def test_a_builder_and_a_recording_give_the_same_submaps_in_any_order(steps, length_m):
    poses = np.array([pose(0.3 * i, 3.0 * i) for i in steps])
    recording, clouds = drive(poses)
    builder, whole = SubmapBuilder(length_m=length_m), submaps(recording, poses, length_m=length_m)
    built = [builder.add(points, one) for points, one in zip(clouds.values(), poses, strict=True)]
    for row in (39, 0, 20, 21):
        np.testing.assert_array_equal(whole.points(row), built[row])
    assert length_m < 1 or len(built[39]) > 1.1 * len(clouds[Path("039.bin")])


def test_a_nearer_point_hides_those_behind_it_in_a_submap_as_in_a_scan():
    near, behind, beside = [5.0, 0.1, 0.5], [10.0, 0.2, 1.0], [10.0, 2.0, 1.0]
    builder = SubmapBuilder()
    builder.add(np.array([near], np.float32), pose(0.0))
    found = builder.add(np.array([behind, beside], np.float32), pose(0.0))
    np.testing.assert_allclose(found, np.array([beside, near]), atol=1e-6)


@pytest.mark.parametrize("step", [pose(0.0, 30.0), pose(0.01), pose(1e4)])
def test_memory_is_bounded_for_a_robot_that_turns_creeps_or_jumps(step):
    builder, where, sizes = SubmapBuilder(length_m=10.0), np.eye(4), []
    points = np.random.default_rng(1).uniform(-10, 10, (50, 3)).astype(np.float32)
    for _ in range(60):
        builder.add(points, where)
        sizes.append(len(builder._scans))
        where = where @ step
    assert max(sizes) <= 10 + 19 and sizes[-1] == sizes[-2]


def test_an_older_scan_that_cannot_be_read_is_left_out_and_told():
    poses = np.array([pose(1.0 * i) for i in range(4)])
    recording, clouds = drive(poses)
    clouds[Path("001.bin")] = np.full((5, 3), np.nan, np.float32)
    found = submaps(recording, poses)
    with pytest.raises(ValueError, match="scan 001 of sequence 08: expected finite points"):
        found.points(1)
    with pytest.warns(DataWarning, match="001: left out of the submaps of later scans: .*expected finite points"):
        assert len(found.points(3)) > len(clouds[Path("003.bin")])


def test_labels_stay_with_their_points(tmp_path):
    poses = np.array([pose(2.0 * i) for i in range(3)])
    paths = tuple(tmp_path / f"{i}.label" for i in range(3))
    for i, path in enumerate(paths):
        np.full(len(seen_from(poses[i])), 40 + i, "<u4").tofile(path)
    recording, _ = drive(poses, label_paths=(*paths[:2], None))
    scan = submaps(recording, poses).scan(1)
    assert set(scan.labels) == {40, 41} and scan.labels.shape == (len(scan.points),)
    assert scan.labels[0] == 41  # the newest scan comes first
    assert submaps(recording, poses).scan(2).labels is None


@pytest.mark.parametrize(
    ("poses", "options", "message"),
    [
        (np.eye(4)[None], {}, "08: expected poses of 2 scans, found poses of 1 scans"),
        (np.zeros((2, 4, 4)), {}, r"08: expected poses \(n, 4, 4\), with rotations, found .* in row 0"),
        (np.tile(np.eye(4), (2, 1, 1)), {"length_m": -1.0}, "expected length_m in metres, more than 0, found -1.0"),
        (np.tile(np.eye(4), (2, 1, 1)), {"keyframe_m": 0.0}, "expected keyframe_m in metres, more than 0, found 0.0"),
    ],
)
def test_invalid_arguments_are_one_clear_error(poses, options, message):
    recording, _ = drive(np.array([pose(0.0), pose(1.0)]))
    with pytest.raises(ValueError, match=message):
        submaps(recording, poses, **options)
