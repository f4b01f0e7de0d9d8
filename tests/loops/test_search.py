"""The search of one and of several sessions: odometry that contradicts the loops, reasons, transforms."""

import dataclasses
import typing
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from recordings import of_images, of_scans

from sglpr_jax.data.formats.pose_files import CAMERA_FROM_LIDAR
from sglpr_jax.data.levelling import check_level
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.scan_stream import only
from sglpr_jax.data.warning import DataWarning
from sglpr_jax.loops import search
from sglpr_jax.loops.candidates import Compared
from sglpr_jax.loops.closure import MEANING, Loop, Reason, Rejected, counted, listed, why_rejected
from sglpr_jax.loops.comparison import NO_FITS
from sglpr_jax.loops.config import CandidateConfig, DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.loops.probability import AdditiveModel, Curve, LoopModel
from sglpr_jax.loops.result import FoundLoops, Session, why_none
from sglpr_jax.loops.search import find_loops
from sglpr_jax.se3 import inverse, transform, yaw_of

N = 40
ALWAYS = LoopModel(AdditiveModel({"deviation": Curve((0.0,), (0.0,))}, 10.0), "everything")
CONFIG = DetectorConfig()


@pytest.fixture(scope="module")
def there_and_back() -> np.ndarray:
    """Poses along a bend, 2 m apart, and back, now nearer to the first lane, now farther from it."""
    there = np.stack([transform(20 * np.sin(a), 20 - 20 * np.cos(a), a) for a in np.arange(N) / 10])
    aside = np.stack([transform(0.0, 3 + 2 * np.sin(i), np.pi) for i in np.arange(N)])
    return np.concatenate([there, (there @ aside)[::-1]])


def searched(
    params, compare_only, poses: np.ndarray, odometry: np.ndarray, *, wrong: Mapping[int, int] = MappingProxyType({})
) -> LoopDetector:
    """The detector after a drive of which each frame of the way back has its true loop.

    `wrong` has frames before that, each with a match that looks as if it was the same place.
    """
    detector = LoopDetector(params, model=ALWAYS, config=CONFIG)
    seen = Seen(np.zeros(detector.finder.index.width, np.float32), np.ones((152, 152), np.uint8), None)
    true = {query: (2 * N - 1 - query, inverse(poses[2 * N - 1 - query]) @ poses[query]) for query in range(N, 2 * N)}
    compare_only(true | {query: (match, np.eye(4)) for query, match in wrong.items()})
    for pose in odometry:
        detector.add_seen(seen, odometry=pose, compared=Compared(NO_FITS, None))
    return detector


@pytest.fixture
def found(params, there_and_back, compare_only, monkeypatch):
    """What `find_loops` makes of the drive with this odometry; nothing is described, the detector has seen it all."""
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(2 * N)})

    def found(odometry):
        detector = searched(params, compare_only, there_and_back, odometry)
        monkeypatch.setattr(search, "LoopDetector", lambda *_, **__: detector)
        return search.find_loops(recording, params, odometry=odometry, config=CONFIG, registered=False)

    return found


@pytest.mark.slow
@pytest.mark.parametrize("share", [1.0, 1.01])
def test_odometry_in_the_lidars_axes_agrees_with_the_loops_drifting_as_it_may(found, there_and_back, share):
    odometry = there_and_back.copy()
    odometry[:, :3, 3] *= share  # a warning is an error
    assert len(found(odometry).loops) >= N - 1


@pytest.mark.slow
def test_odometry_in_other_axes_is_told(found, there_and_back):
    forward_is_y = there_and_back @ transform(0.0, 0.0, np.pi / 2)
    words = r"08: the odometry contradicts the loops of \d\d of \d\d frames, .* use these axes: x forward"
    with pytest.warns(DataWarning, match=words):
        assert len(found(forward_is_y).loops) < N / 2


def test_odometry_in_the_cameras_axes_is_told_by_its_way_too(there_and_back):
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(2 * N)})
    check_level(there_and_back, recording)
    camera = CAMERA_FROM_LIDAR @ there_and_back @ CAMERA_FROM_LIDAR.T
    check_level(camera[:5], only(recording, range(5)))
    words = r"08: expected poses of a LiDAR that moves along the ground .*, found \d+ of \d+ m of path up or down"
    with pytest.warns(DataWarning, match=words):
        check_level(camera, recording)
    forward = dataclasses.replace(recording, mounting=Mounting(1.0, (1.0, 0.0, 0.0)))
    with pytest.warns(DataWarning, match=words):
        check_level(there_and_back, forward)


@pytest.mark.slow
def test_loops_that_contradict_the_odometry_are_rejected_and_do_not_keep_the_true_ones_out(
    params, there_and_back, compare_only, monkeypatch
):
    """A few frames before the first revisit look like ten frames further on, again and again."""
    alike = range(N - 8, N)
    detector = searched(params, compare_only, there_and_back, there_and_back, wrong={i: i - 30 for i in alike})
    true = {loop.query for loop in detector.loops}
    wrong = {one.loop.query for one in detector.rejected}
    assert len(wrong) >= 7 and wrong <= set(alike) and not true & wrong and len(true) >= N - 1
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(2 * N)})
    monkeypatch.setattr(search, "LoopDetector", lambda *_, **__: detector)
    whole = search.find_loops(recording, params, odometry=there_and_back, config=CONFIG, registered=False)
    assert {one.loop.query for one in whole.rejected} == wrong and len(whole.loops) >= N - 1
    assert {one.reason for one in whole.rejected} == {"contradicts the odometry"}
    assert str(whole).endswith(f"{len(wrong)} rejected (contradicts the odometry: {len(wrong)})")


LOOP = Loop(5, 0, np.eye(4), np.eye(6), 0.995)


def found_in(frames: int, **about) -> FoundLoops:
    """No loops in a recording of this many frames."""
    images = {Path(f"{i:06d}.png"): np.eye(8, dtype=np.float32) for i in range(frames)}
    return FoundLoops((Session(of_images(images), frames, **about),))


def with_frames(found: FoundLoops, frames: int) -> FoundLoops:
    return dataclasses.replace(found, sessions=(dataclasses.replace(found.sessions[0], frames=frames),))


def test_a_drive_that_never_comes_back_compares_no_pair():
    (said,) = why_none(found_in(700))
    recent_m = CandidateConfig().recent_m
    assert said.startswith("No pair was compared: according to the images") and f"at least {recent_m:g} m" in said
    assert "according to the odometry" in why_none(found_in(700, odometry=np.tile(np.eye(4), (700, 1, 1))))[0]


def test_empty_unreadable_and_unseen_scans_are_reasons():
    assert "690 of 700 scans are almost empty (fewer than 20" in why_none(found_in(700, empty=690))[0]
    skipped = tuple(map(str, range(400)))
    assert why_none(found_in(700, skipped=skipped))[0] == "400 of 700 scans cannot be read."
    stopped = found_in(700)
    assert why_none(with_frames(stopped, 0)) == ["The search was stopped before the first scan."]
    first, second = why_none(with_frames(stopped, 5))
    assert first == "The search was stopped after 5 of 700 frames." and second.startswith("No pair was compared")


def test_the_most_frequent_reason_is_given_and_loops_need_none():
    rejected = (Rejected(LOOP, "little overlap"), Rejected(LOOP, "repeats"), Rejected(LOOP, "repeats"))
    found = dataclasses.replace(found_in(700), rejected=rejected)
    assert why_none(found) == [f"3 pairs were compared. For 2 of them: {MEANING['repeats']}"]
    assert why_none(dataclasses.replace(found, loops=(LOOP,))) == []


def test_each_reason_has_a_meaning_and_a_count():
    assert set(MEANING) == set(typing.get_args(Reason))
    assert counted([]) == {} and listed({}) == "" and why_rejected([]) == []
    lines = why_rejected([Rejected(LOOP, reason) for reason in MEANING])
    assert lines == [f"rejected, {reason} (1): {meaning}" for reason, meaning in MEANING.items()]


def test_degenerate_loops_are_counted_and_can_be_rejected():
    unsure = dataclasses.replace(LOOP, query=3, covariance=np.diag([4.0, 0.01, 1, 1, 1, 1]))
    found = dataclasses.replace(found_in(9), loops=(unsure, dataclasses.replace(LOOP, covariance=np.eye(6) / 4)))
    assert str(found).startswith("2 loops (1 degenerate) in 9 of 9 frames")
    left = found.without_degenerate()
    assert [loop.query for loop in left.loops] == [5]
    assert [(one.loop.query, one.reason) for one in left.rejected] == [(3, "degenerate")]
    assert "1 rejected (degenerate: 1)" in str(left)


PART = 26


def part_of(drive, middle: int, name: str):
    """Scans around one of the drive, as a recording of their own, and their true poses in the frame of the first."""
    rows = list(range(max(middle - PART // 2, 0), min(middle + PART // 2, len(drive))))
    poses = drive.poses.world_from_lidar[rows]
    recording = dataclasses.replace(only(drive, rows), name=name, rows=None, positions=None)
    return recording, inverse(poses[0]) @ poses, poses[0]


@pytest.mark.slow
def test_one_street_on_two_days_has_a_transform_with_and_without_odometry(drive, revisit, params):
    query, match = revisit
    (first, first_poses, first_frame), (second, second_poses, second_frame) = (
        part_of(drive, frame, name) for frame, name in ((match, "first"), (query, "second"))
    )
    both, steps = [first, second], []
    found = find_loops(both, params, odometry=[first_poses, second_poses], on_progress=steps.append)
    assert found.whole and steps == list(range(1, len(first) + 2 * len(second) + 1))
    assert len(found.between(0, 1).loops) >= 5 and found.transforms[0].match.is_odometry
    error = inverse(inverse(first_frame) @ second_frame) @ found.transforms[0].match_from_query
    assert np.linalg.norm(error[:2, 3]) < 0.3 and abs(np.degrees(yaw_of(error))) < 0.5
    assert "first and second: " in str(found) and "transform x " in str(found)
    bare = find_loops(both, params).between(0, 1)
    assert bare.transforms and not bare.transforms[0].match.is_odometry and len(bare.loops) >= 5
    assert found.within(1).recording is found.sessions[1].recording


@pytest.mark.slow
def test_different_streets_have_no_common_place(drive, revisit, params):
    apart = np.linalg.norm(drive.positions - drive.positions[revisit[0]], axis=1)
    far = int(np.argmax(np.where(np.arange(len(drive)) < len(drive) - PART, apart, 0)))
    parts = [part_of(drive, frame, name)[0] for frame, name in ((revisit[0], "here"), (far, "there"))]
    found = find_loops(parts, params)
    assert not found.transforms and not found.between(0, 1).loops
    assert str(found).splitlines()[-1].startswith("here and there: no common place found")
    stopped = find_loops(parts, params, should_stop=lambda: True)
    assert not stopped.whole and not stopped.loops and not stopped.rejected


@pytest.mark.parametrize(("recordings", "odometry"), [(0, None), (2, 1)])
def test_other_numbers_of_recordings_and_odometry_are_refused(drive, params, recordings, odometry):
    given = None if odometry is None else odometry * [drive.poses.world_from_lidar]
    with pytest.raises(ValueError, match=f"expected recordings with odometry of each, found {recordings} with"):
        find_loops(recordings * [drive], params, odometry=given)
