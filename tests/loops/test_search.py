"""The search of one and of several sessions: odometry that contradicts the loops, reasons, transforms."""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from drives import PASS, SCANS, part_of_drive
from recordings import of_images, of_scans

from sglpr_jax.data.formats.pose_files import CAMERA_FROM_LIDAR
from sglpr_jax.data.gravity import with_odometry
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.data.scan_stream import only
from sglpr_jax.files import DataWarning
from sglpr_jax.loops import search
from sglpr_jax.loops.closure import MEANING, LoopClosure, RejectedClosure
from sglpr_jax.loops.comparison import NO_FITS
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Keyframe
from sglpr_jax.loops.probability import AdditiveModel, Curve, LoopModel
from sglpr_jax.loops.result import LoopSearchResult, Session, diagnose_no_loops
from sglpr_jax.loops.search import find_loops
from sglpr_jax.odometry.drift_check import OdometryCheck
from sglpr_jax.se3 import inverse, transform, yaw_of

N = 40
ALWAYS = LoopModel(AdditiveModel({"deviation": Curve((0.0,), (0.0,))}, 10.0), "everything")
CONFIG = DetectorConfig()


@functools.cache
def there_and_back() -> np.ndarray:
    """Poses 2 m apart along a bend and back, at a varying distance from the first lane."""
    there = np.stack([transform(20 * np.sin(a), 20 - 20 * np.cos(a), a) for a in np.arange(N) / 10])
    aside = np.stack([transform(0.0, 3 + 2 * np.sin(i), np.pi) for i in np.arange(N)])
    return np.concatenate([there, (there @ aside)[::-1]])


@pytest.fixture
def found(params, compare_only, monkeypatch):
    """Result of `find_loops` for a drive on which each frame of the way back has its true loop. Nothing is described.

    `wrong` has frames before that, each with a match that looks as if it was the same place. Poses are divided by
    `scale`.
    """
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(2 * N)})

    def found(
        odometry: np.ndarray, *, wrong: Mapping[int, int] = MappingProxyType({}), scale: int = 1
    ) -> LoopSearchResult:
        detector, poses = LoopDetector(params, model=ALWAYS, config=CONFIG), there_and_back()
        keyframe = Keyframe(np.zeros(detector.finder.index.width, np.float32), np.ones((152, 152), np.uint8), None)
        ways = {query: 2 * N - 1 - query for query in range(N, 2 * N)}
        true = {query: (match, inverse(poses[match]) @ poses[query]) for query, match in ways.items()}
        compare_only(true | {query: (match, np.eye(4)) for query, match in wrong.items()})
        for pose in odometry:
            detector.add_keyframe(keyframe, odometry=pose, fits=NO_FITS)
        monkeypatch.setattr(search, "LoopDetector", lambda *_, **__: detector)
        odometry = scaled_poses(odometry, 1 / scale)
        options = {"odometry": odometry, "config": CONFIG, "registered": False}
        return search.find_loops(recording, params, **options, scale=scale)

    return found


@pytest.mark.slow
def test_odometry_in_the_lidars_axes_agrees_with_the_loops_drifting_as_it_may(found):
    odometry = there_and_back().copy()
    odometry[:, :3, 3] *= 1.01  # a warning is an error
    result = found(odometry, scale=4)
    assert len(result.loops) >= N - 1 and result.config == CONFIG and result.scale == 4
    assert str(result).endswith(", scale 4")
    np.testing.assert_array_equal(result.sessions[0].odometry, scaled_poses(odometry, 1 / 4))
    for loop in result.loops:
        true = inverse(there_and_back()[loop.match]) @ there_and_back()[loop.query]
        np.testing.assert_allclose(loop.match_from_query, scaled_poses(true[None], 1 / 4)[0], atol=1e-6)
        assert loop.covariance[0, 0] == pytest.approx(0.05**2 / 4**2, rel=0.5)


@pytest.mark.slow
def test_odometry_in_other_axes_is_told(found):
    forward_is_y = there_and_back() @ transform(0.0, 0.0, np.pi / 2)
    words = r"08: the odometry contradicts the loops of \d\d of \d\d frames, .* use these axes: x forward"
    with pytest.warns(DataWarning, match=words):
        assert len(found(forward_is_y).loops) < N / 2


@pytest.mark.slow
def test_odometry_that_the_images_contradict_is_told_with_the_difference_and_not_used(found, monkeypatch):
    monkeypatch.setattr(OdometryCheck, "errors", (0.5, 0.02))  # the images of this drive are made up
    words = r"08: the odometry contradicts the motion .* differs by 50 % .* and 2 degrees per 100 m"
    with pytest.warns(DataWarning, match=words):
        assert found(there_and_back()).sessions[0].odometry is None


def test_odometry_in_the_cameras_axes_is_told_by_its_way_too():
    poses = there_and_back()
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(2 * N)})
    with_odometry(recording, poses)
    camera = CAMERA_FROM_LIDAR @ poses @ CAMERA_FROM_LIDAR.T
    with_odometry(only(recording, range(5)), camera[:5])
    words = r"08: expected poses of a LiDAR that moves along the ground .*, found \d+ of \d+ m of path up or down"
    forward = dataclasses.replace(recording, mounting=Mounting(1.0, (1.0, 0.0, 0.0)))
    for given, one in ((camera, recording), (poses, forward)):
        with pytest.warns(DataWarning, match=words):
            with_odometry(one, given)


@pytest.mark.slow
def test_loops_that_contradict_the_odometry_are_rejected_and_do_not_keep_the_true_ones_out(found):
    """A few frames before the first revisit look like ten frames further on, again and again."""
    alike = range(N - 8, N)
    result = found(there_and_back(), wrong={i: i - 30 for i in alike})
    rejected = {one.loop.query for one in result.rejected}
    assert len(rejected) >= 7 and rejected <= set(alike) and len(result.loops) >= N - 1
    assert not rejected & {loop.query for loop in result.loops}
    assert {one.reason for one in result.rejected} == {"contradicts the odometry"}
    assert str(result).endswith(f"{len(rejected)} rejected (contradicts the odometry: {len(rejected)})")


LOOP = LoopClosure(5, 0, np.eye(4), np.eye(6), 0.995)


def found_in(frames: int, **about) -> LoopSearchResult:
    """No loops in a recording of this many frames."""
    images = {Path(f"{i:06d}.png"): np.eye(8, dtype=np.float32) for i in range(frames)}
    return LoopSearchResult((Session(of_images(images), frames, keyframes=frames, **about),))


def test_what_is_missing_explains_why_there_are_no_loops():
    (said,) = diagnose_no_loops(found_in(700))
    assert said.startswith("No pair was possible: according to the images")
    odometry = np.tile(np.eye(4), (700, 1, 1))
    odometry[1:, 0, 3] = 0.7
    (said,) = diagnose_no_loops(found_in(700, odometry=odometry))
    assert "according to the odometry, which is 0.7 m long, no scan came back" in said
    assert "690 of 700 scans are almost empty (fewer than 20" in diagnose_no_loops(found_in(700, empty=690))[0]
    skipped = tuple(map(str, range(400)))
    assert diagnose_no_loops(found_in(700, skipped=skipped))[0] == "400 of 700 scans cannot be read."
    for frames, words in ((0, "before the first scan."), (5, "after 5 of 700 frames.")):
        session = dataclasses.replace(found_in(700).sessions[0], frames=frames)
        assert diagnose_no_loops(LoopSearchResult((session,)))[0] == f"The search was stopped {words}"
    rejected = (
        RejectedClosure(LOOP, "little overlap"),
        RejectedClosure(LOOP, "repeats"),
        RejectedClosure(LOOP, "repeats"),
    )
    found = dataclasses.replace(found_in(700), rejected=rejected)
    assert diagnose_no_loops(found) == [f"3 pairs were rejected. For 2 of them: {MEANING['repeats']}"]
    assert diagnose_no_loops(dataclasses.replace(found, loops=(LOOP,))) == []
    twice = LoopSearchResult(found_in(700).sessions * 2)
    assert [line.split(":")[0] for line in diagnose_no_loops(twice)] == ["08", "08~2"]


def test_degenerate_loops_are_counted_and_can_be_rejected():
    unsure = dataclasses.replace(LOOP, query=3, covariance=np.diag([4.0, 0.01, 1, 1, 1, 1]))
    found = dataclasses.replace(found_in(9), loops=(unsure, dataclasses.replace(LOOP, covariance=np.eye(6) / 4)))
    assert str(found).startswith("2 loops (1 degenerate) in 9 of 9 frames")
    left = found.without_degenerate()
    assert [loop.query for loop in left.loops] == [5]
    assert [(one.loop.query, one.reason) for one in left.rejected] == [(3, "degenerate")]
    assert "1 rejected (degenerate: 1)" in str(left)


@pytest.mark.slow
def test_one_street_on_two_days_has_a_transform_with_and_without_odometry(params):
    rows = range(0, 2 * PASS, 2), range(SCANS - 2 * PASS, SCANS, 2)
    both = [part_of_drive(*given) for given in zip(rows, ("first", "second"), strict=True)]
    both[0] = dataclasses.replace(both[0], rows=np.arange(100, 100 + PASS))  # 100 scans before are left out
    frames, steps = [one.poses.world_from_lidar[0] for one in both], []
    odometry = [inverse(frame) @ one.poses.world_from_lidar for frame, one in zip(frames, both, strict=True)]
    found = find_loops(both, params, odometry=odometry, on_progress=steps.append)
    assert found.whole and steps == sorted(set(steps)) and steps[0] == 1 and steps[-1] == 3 * PASS
    assert len(found.between(0, 1).loops) >= 5 and found.transforms[0].match.is_odometry
    error = inverse(inverse(frames[0]) @ frames[1]) @ found.transforms[0].match_from_query
    assert np.linalg.norm(error[:2, 3]) < 0.3 and abs(np.degrees(yaw_of(error))) < 0.5
    assert "first and second: " in str(found) and "transform x " in str(found)
    assert found.within(1).sessions[0].recording is found.sessions[1].recording
    bare = find_loops(both, params, registered=False).between(0, 1)
    assert bare.transforms and not bare.transforms[0].match.is_odometry and len(bare.loops) >= 5
    assert 100 <= bare.transforms[0].match.first < bare.transforms[0].match.last < 100 + PASS


@pytest.mark.slow
def test_different_streets_have_no_common_place(params):
    parts = [part_of_drive(range(first, first + 30, 2), name) for first, name in ((0, "here"), (110, "there"))]
    found = find_loops(parts, params)
    assert not found.transforms and not found.between(0, 1).loops
    assert str(found).splitlines()[-1].startswith("here and there: no common place found")
    stopped = find_loops(parts, params, should_stop=lambda: True)
    assert not stopped.whole and not stopped.loops and not stopped.rejected


@pytest.mark.parametrize(
    ("recordings", "odometry", "message"),
    [
        (0, None, "expected recordings with odometry of each, found 0 with"),
        (2, 1, "expected recordings with odometry of each, found 2 with"),
        (1, 1, "08: expected odometry of 40 scans, found odometry of 3"),
    ],
)
def test_other_numbers_of_recordings_odometry_and_poses_are_refused(street, params, recordings, odometry, message):
    given = None if odometry is None else odometry * [np.stack([np.eye(4)] * 3)]
    with pytest.raises(ValueError, match=message):
        find_loops(recordings * [street], params, odometry=given)
