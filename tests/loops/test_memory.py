"""A detector with limits stores fewer scans, and finds right loops; without limits nothing changes."""

import dataclasses

import numpy as np
import pytest

from sglpr_jax.loops.candidates import CandidateFinder, Compared
from sglpr_jax.loops.comparison import NO_FITS
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Seen, StoredScans
from sglpr_jax.retrieval.index import Index
from sglpr_jax.se3 import inverse, transform

LIMIT = 150


def searched(params, drive, described, *, odometry: bool, **limits) -> LoopDetector:
    """The detector after the drive. It never stores more scans than its limit."""
    detector, poses = LoopDetector(params, config=DetectorConfig(**limits)), drive.poses.world_from_lidar
    for i, seen in enumerate(described):
        detector.add_seen(seen, time=float(drive.times[i]), odometry=poses[i] if odometry else None)
        assert len(detector.finder.stored) <= limits.get("max_places", len(drive))
    return detector


def pairs(detector: LoopDetector) -> list[tuple]:
    return [(one.query, one.match, one.probability, one.match_from_query.tobytes()) for one in detector.loops]


@pytest.mark.slow
@pytest.mark.parametrize("odometry", [False, True])
def test_loops_with_limits_are_right_and_limits_that_are_not_reached_change_nothing(params, drive, described, odometry):
    whole = searched(params, drive, described, odometry=odometry)
    same = searched(params, drive, described, odometry=odometry, keyframe_m=0.0, max_places=len(drive))
    assert pairs(same) == pairs(whole) and len(whole.finder.stored) == len(drive)
    few = searched(params, drive, described, odometry=odometry, keyframe_m=2.0, max_places=LIMIT)
    stored = few.finder.stored
    assert len(stored) > LIMIT / 2 and few.finder.index.ids == [f"{frame:06d}" for frame in stored.frames]
    poses = drive.poses.world_from_lidar
    for loop in few.loops:
        error = inverse(inverse(poses[loop.match]) @ poses[loop.query]) @ loop.match_from_query
        assert np.linalg.norm(error[:2, 3]) < 2
    assert len({loop.query for loop in few.loops}) > len(whole.loops) / 3
    assert few.nbytes < whole.nbytes


def driven(params, step_m: float, turn_deg: float = 0.0, *, frames: int = 41, **limits) -> CandidateFinder:
    """A finder after frames that are `step_m` metres apart, all with one image."""
    finder = CandidateFinder(params, DetectorConfig(**{"keyframe_m": 0.0, **limits}))
    seen = Seen(np.zeros(finder.index.width, np.float32), np.ones((152, 152), np.uint8), None)
    for frame in range(frames):
        pose = transform(step_m * frame, 0.0, np.radians(turn_deg * frame))
        finder.add_seen(seen, odometry=pose, compared=Compared(NO_FITS, None))
    return finder


def test_a_scan_near_the_last_stored_one_is_not_stored_unless_the_sensor_turned(params):
    assert driven(params, 0.25, keyframe_m=1.0).stored.frames.tolist() == list(range(0, 41, 4))
    assert driven(params, 0.0, 5.01, keyframe_m=1.0).stored.frames.tolist() == list(range(0, 41, 4))
    assert driven(params, 0.25).stored.frames.tolist() == list(range(41))
    assert len(driven(params, 0.25, keyframe_m=1.0)) == 41


def test_after_a_motion_that_is_unknown_a_scan_is_stored(params):
    finder = CandidateFinder(params, DetectorConfig(keyframe_m=1e9))
    seen = Seen(np.zeros(finder.index.width, np.float32), np.ones((152, 152), np.uint8), None)
    for _ in range(3):
        finder.add_seen(seen, compared=Compared(NO_FITS, None))  # without links the motion is unknown
    assert finder.stored.frames.tolist() == [int(np.flatnonzero(finder.motion.segments == k)[0]) for k in range(3)]


@pytest.mark.slow
def test_memory_stays_bounded(params):
    sizes = [driven(params, 1.0, frames=frames, max_places=32) for frames in (300, 2000)]
    assert all(len(one.stored) <= 32 for one in sizes)
    assert sizes[0].stored.nbytes == sizes[1].stored.nbytes
    assert sizes[1].nbytes - sizes[0].nbytes < 350 * 2048
    whole = driven(params, 1.0, frames=2000)
    assert whole.nbytes > sizes[1].nbytes + 1000 * 2000


def test_scans_with_a_loop_to_a_newer_one_are_forgotten_first_then_the_oldest():
    stored = StoredScans(Index.empty(1))
    for frame in range(0, 100, 10):
        stored.add(frame, np.array([frame], np.float32), np.full((2, 2), frame, np.uint8))
    stored.close_loop(90, 40)
    stored.close_loop(95, 20)  # 95 is not stored, so nothing represents the place of 20
    stored.close_loop(80, 45)
    stored.forget(1)
    assert stored.frames.tolist() == [0, 10, 20, 30, 50, 60, 70, 80, 90]
    stored.forget(2)
    assert stored.frames.tolist() == [20, 30, 50, 60, 70, 80, 90]
    assert [int(stored.image(row)[0, 0]) for row in range(7)] == stored.frames.tolist()
    assert stored.index.query([52.0]).rows.tolist() == [2]
    stored.add(100, np.array([52], np.float32), np.full((2, 2), 100, np.uint8))
    assert stored.index.query([52.0]).rows.tolist() == [7] and stored.index.ids[-1] == "000100"


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"max_places": 0}, "expected max_places of 1 or more, found 0"),
        ({"keyframe_m": -1.0}, "expected keyframe_m of 0 or more, found -1.0"),
        ({"keyframe_m": np.nan}, "expected keyframe_m of 0 or more, found nan"),
        ({"keyframe_m": np.inf}, "expected keyframe_m of 0 or more, found inf"),
    ],
)
def test_invalid_limits_are_one_clear_error(limits, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(DetectorConfig(), **limits)
