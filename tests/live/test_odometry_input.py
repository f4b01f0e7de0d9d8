"""Times of a live map never go back, odometry continues only if it can, and the mounting is that of the first scans."""

import numpy as np
import pytest

from sglpr_jax.live.odometry_input import (
    FIRST_ODOMETRY_S,
    HOLD_S,
    MOUNTING_SCANS,
    FixedMounting,
    OdometryContinuity,
    ScanClock,
)
from sglpr_jax.se3 import transform


def at(x: float, y: float = 0.0) -> np.ndarray:
    return transform(float(x), float(y), 0.0)


def times(clock: ScanClock, stamps, received=None) -> list[float]:
    received = np.arange(len(stamps)) * 0.1 + 50 if received is None else received
    return [clock.time(stamp, at) for stamp, at in zip(stamps, received, strict=True)]


@pytest.mark.parametrize("other", [1e9 - 3600, 1e9 + 365 * 86400])
def test_a_clock_that_jumps_is_followed(said, other):
    clock, start = ScanClock(said), 1e9
    stamps = [start, start + 0.1, other, other + 0.1, other + 0.2, start + 0.5]
    np.testing.assert_allclose(np.diff(times(clock, stamps)), 0.1, atol=1e-6)
    assert said.kinds == ["time", "clock", "time"]
    assert clock.time(1e9 + 0.6, 50.6) == pytest.approx(start + 0.6) and said.kinds[-1] == "clock"


def test_a_pause_of_a_recording_is_no_change_of_the_clock(said):
    clock = ScanClock(said)
    assert [clock.time(stamp, 50.0, is_recorded=True) for stamp in (1e9, 1e9 + 90)] == [1e9, 1e9 + 90] and not said


@pytest.mark.parametrize("wrong_s", [-3600.0, -1.0, 3600.0])
def test_a_single_wrong_time_does_not_change_the_clock(said, wrong_s):
    clock = ScanClock(said)
    found = times(clock, [1e9, 1e9 + 0.1 + wrong_s, 1e9 + 0.2, 1e9 + 0.3], received=[50.0, 50.07, 50.2, 50.4])
    np.testing.assert_allclose(found, [1e9, 1e9 + 0.07, 1e9 + 0.2, 1e9 + 0.3], atol=1e-6)
    assert said.kinds == ["time"]


@pytest.mark.parametrize("missing", [0.0, np.nan])
def test_scans_without_a_time_get_that_of_their_arrival(said, missing):
    found = times(ScanClock(said), [1e9, missing, 1e9 + 0.2, missing])
    np.testing.assert_allclose(found, 1e9 + np.arange(4) * 0.1)
    assert said.kinds == ["time", "time"]


def test_a_clock_continues_after_a_restart(said):
    clock = ScanClock(said)
    clock.resume(1e9 + 7, 1e9, received=40.0)
    assert clock.time(1e9 + 10, 50.0) == 1e9 + 17 and not said


def placed(continuity: OdometryContinuity, given) -> list[bool | None]:
    """Whether each scan continues; None: left out."""
    found = [continuity.add(pose, time) for time, pose in given]
    return [None if one is None else one.continues for one in found]


def test_odometry_that_jumps_or_is_reset_begins_anew(said):
    drive = [(0.0, at(0)), (0.1, at(1)), (0.2, at(90)), (0.3, at(91)), (0.4, at(97)), (0.5, at(5)), (0.6, at(0))]
    found = placed(OdometryContinuity(said, expected=True), drive)
    assert found == [True, True, False, True, True, False, False]
    assert said.kinds == ["jump"] * 3


def test_a_reset_is_noticed_if_the_lidar_is_beside_the_origin(said):
    begin = transform(0.3, 0.5, 0.0)
    drive = [(0.1 * i, at(0.1 * i) @ begin) for i in range(51)]
    found = placed(OdometryContinuity(said, expected=True), [*drive, (5.1, begin)])
    assert found == [True] * 51 + [False] and said.kinds == ["jump"]


def test_odometry_that_passes_its_begin_at_speed_continues(said):
    drive = [(0.1 * i, at(1.5 * (i - 9))) for i in range(20)]
    assert all(placed(OdometryContinuity(said, expected=True), drive)) and not said


def test_odometry_that_is_missing_is_told_and_a_scan_may_be_left_out_for_a_while(said):
    given = [(0.0, at(0)), (HOLD_S - 0.1, None), (HOLD_S + 0.1, None), (HOLD_S + 0.2, at(1)), (30.0, None)]
    continuity = OdometryContinuity(said, expected=True)
    found = [continuity.add(pose, time) for time, pose in given]
    assert [one.pose is None for one in found] == [False, True, True, False, True]
    assert all(one.continues for one in found)
    assert [one.may_be_left_out for one in found] == [False, True, False, False, True]
    assert said.kinds == ["missing"] * 3


def test_the_first_scans_wait_for_odometry(said):
    continuity = OdometryContinuity(said, expected=True)
    assert placed(continuity, [(5.0, None), (6.0, at(0))]) == [None, True]
    late = OdometryContinuity(said, expected=True)
    assert placed(late, [(5.0, None), (5.0 + FIRST_ODOMETRY_S, None), (16.0, at(0))]) == [None, True, True]
    assert late.add(at(0), 17.0).pose is None
    assert said.kinds == ["wait", "wait", "wait over", "odometry", "odometry"]


@pytest.mark.parametrize(
    ("last", "pose", "seconds", "continues"),
    [
        (at(40), at(43), 5.0, True),
        (at(40), at(0), 5.0, False),  # it was reset
        (at(40), at(43), 3600.0, False),
        (at(40), at(1e4), 5.0, False),
        (None, None, 5.0, False),
    ],
)
def test_after_a_restart_the_way_is_known_only_if_the_odometry_continues(said, last, pose, seconds, continues):
    continuity = OdometryContinuity(said, expected=False)
    continuity.resume(last, 100.0)
    first = continuity.add(pose, 100.0 + seconds)
    assert first.continues == continues and said.kinds == ["restart"]
    assert continuity.add(pose, 100.1 + seconds).continues


def test_the_mounting_is_that_of_the_first_scans(drive):
    first = FixedMounting()
    found = [first.add(drive.points(i)) for i in range(MOUNTING_SCANS + 1)]
    assert found[-1] == found[-2] and abs(found[-1].height_m - 1.73) < 0.15
    assert FixedMounting(2.5).add(drive.points(0)).height_m == 2.5
