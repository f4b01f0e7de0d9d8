"""Two simulated recordings of one street are aligned with and without odometry; different streets are not."""

import dataclasses

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.data.scan_stream import only
from sglpr_jax.loops.search_between import find_loops_between
from sglpr_jax.odometry.bev_odometry import GAP_M, Motion
from sglpr_jax.se3 import inverse, transform, yaw_of

SCANS = 26


@pytest.fixture(scope="module")
def params():
    return sglpr_jax.load("sglpr")


def part_of(drive, middle: int, name: str):
    """Scans around one of the drive, as a recording of their own, and their true poses in the frame of the first."""
    rows = list(range(max(middle - SCANS // 2, 0), min(middle + SCANS // 2, len(drive))))
    poses = drive.poses.world_from_lidar[rows]
    recording = dataclasses.replace(only(drive, rows), name=name, rows=None, positions=None)
    return recording, inverse(poses[0]) @ poses, poses[0]


@pytest.mark.slow
def test_one_street_on_two_days_has_a_transform_with_and_without_odometry(drive, revisit, params):
    query, match = revisit
    (first, first_poses, first_frame), (second, second_poses, second_frame) = (
        part_of(drive, frame, name) for frame, name in ((match, "first"), (query, "second"))
    )
    steps = []
    found = find_loops_between([first, second], params, odometry=[first_poses, second_poses], on_progress=steps.append)
    assert found.whole and steps == list(range(1, len(first) + 2 * len(second) + 1))
    (pair,) = found.between
    assert len(pair.loops) >= 5 and pair.aligned[0].match.is_odometry
    error = inverse(inverse(first_frame) @ second_frame) @ pair.aligned[0].alignment.match_from_query
    assert np.linalg.norm(error[:2, 3]) < 0.3 and abs(np.degrees(yaw_of(error))) < 0.5
    assert "first and second: " in str(found) and "transform x " in str(found)
    bare = find_loops_between([first, second], params).between[0]
    assert bare.aligned and not bare.aligned[0].match.is_odometry and len(bare.loops) >= 5


@pytest.mark.slow
def test_different_streets_have_no_common_place(drive, revisit, params):
    apart = np.linalg.norm(drive.positions - drive.positions[revisit[0]], axis=1)
    far = int(np.argmax(np.where(np.arange(len(drive)) < len(drive) - SCANS, apart, 0)))
    parts = [part_of(drive, frame, name)[0] for frame, name in ((revisit[0], "here"), (far, "there"))]
    found = find_loops_between(parts, params)
    assert not found.between[0].aligned and not found.between[0].loops
    assert str(found).splitlines()[-1].startswith("here and there: no common place found")
    stopped = find_loops_between(parts, params, should_stop=lambda: True)
    assert not stopped.whole and stopped.between[0].compared == 0


def test_too_few_recordings_or_odometry_are_refused(drive, params):
    with pytest.raises(ValueError, match="expected at least two recordings, found 1"):
        find_loops_between([drive], params)
    with pytest.raises(ValueError, match="expected odometry of 2 recordings, found that of 1"):
        find_loops_between([drive, drive], params, odometry=[drive.poses.world_from_lidar])


def straight(frames: int) -> Motion:
    motion = Motion()
    for frame in range(frames):
        motion.add(float(frame), pose=transform(4.0 * frame, 0.0, 0.0))
    return motion


def test_joined_motions_keep_their_poses_and_are_apart():
    first, second = straight(5), straight(3)
    joined = Motion.joined([first, second], [np.eye(3)] * 2)
    assert joined.segments.tolist() == [0] * 5 + [1] * 3 and len(joined) == 8
    np.testing.assert_array_equal(joined.poses[5:], second.poses)
    np.testing.assert_allclose(np.diff(joined.travelled), [4, 4, 4, 4, GAP_M, 4, 4])
