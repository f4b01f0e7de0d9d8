"""Time, sensor mounting and odometry of each scan of a live map, robust to clock changes, resets and restarts."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from sglpr_jax.data.choices import SensorHeight
from sglpr_jax.data.mounting import Mounting, common_mounting, estimate_mounting
from sglpr_jax.live.data_types import Report

JUMP_S = 60.0
"""Maximum lead of a header's time over the time since the last scan, in seconds. Beyond it, the clock changed."""
MOUNTING_SCANS = 11
"""Number of scans from which the mounting is estimated."""
FASTEST_M_PER_S, SLACK_M = 60.0, 1.0
"""Maximum speed of a vehicle, and an additional distance between two scans, in metres."""
RESTART_S = 60.0
"""Maximum time without a scan after which the odometry may continue, in seconds."""
RESET_M = 0.2
"""Radius about the origin and about the first pose, in metres. Odometry was reset if it jumps into the radius by more
than five times this distance, unless the step continues the one before."""
HOLD_S = 2.0
"""Maximum time without odometry, in seconds, for which scans that show no motion are left out. The first such scan is
always left out."""
FIRST_ODOMETRY_S = 10.0
"""Time for which the first scans wait for odometry that was asked for, in seconds."""


class OdometryState(NamedTuple):
    """Odometry of a scan for the detector."""

    pose: Float[np.ndarray, "4 4"] | None
    """Pose by odometry. None in a map without odometry, and while it is missing."""
    continues: bool
    """Whether the motion since the last scan is known or, without a pose, can be estimated from the scans."""
    may_be_left_out: bool = False
    """Whether odometry is missing for so short a time that the scan can be left out."""


class OdometryContinuity:
    """Decides for each scan whether its odometry continues. The first scan decides whether the map has odometry."""

    def __init__(self, report: Report, *, expected: bool):
        """Begin a map. `expected` says that odometry was asked for, so that the first scans wait for it."""
        self._report, self._expected = report, expected
        self.has_odometry: bool | None = None
        """Whether the map has odometry. None until the first scan decides."""
        self._began: float | None = None  # time of the first scan, in seconds
        self._last: Float[np.ndarray, "4 4"] | None = None  # last pose by odometry
        self._last_time = 0.0  # time of `_last`, in seconds
        self._first_m = np.zeros(3)  # position of the first pose of the odometry frame
        self._velocity = np.zeros(3)  # of the last step, in metres per second
        self._is_known = True  # whether the motion up to the last scan before a restart is known
        self._misses_pose = False  # whether the last scan had no pose
        self._resumed = False  # whether the next scan is the first one after a restart

    def resume(self, pose: Float[np.ndarray, "4 4"] | None, time: float, *, known: bool = True) -> None:
        """Continue a map of an earlier process, whose last scan had this pose at this time. With `known=False`, the
        motion up to that scan was unknown, and its pose may be that of an earlier scan."""
        self.has_odometry, self._last, self._last_time = pose is not None, pose, time
        self._is_known, self._resumed = known, True

    def add(self, pose: Float[np.ndarray, "4 4"] | None, time: float) -> OdometryState | None:
        """Return the odometry of the next scan, or None if the scan must be skipped. Times must not decrease."""
        if self.has_odometry is None and self._awaits_odometry(pose, time):
            return None
        resumed, self._resumed = self._resumed, False
        if not self.has_odometry:
            if pose is not None:
                self._report("odometry", "expected no odometry, because the map began without it; it is not used")
            if resumed:
                self._report("restart", "the motion since the last scan before the restart is unknown")
            return OdometryState(None, not resumed)
        if pose is None:
            passed_s, is_first = time - self._last_time, not self._misses_pose
            self._misses_pose = True
            self._report(
                "missing", f"expected odometry, found none for {passed_s:.1f} s; the motion is taken from the scans"
            )
            return OdometryState(None, not resumed, not resumed and (is_first or passed_s < HOLD_S))
        continues = self._last is None or (self._is_known and self._is_plausible(pose, time, resumed))
        if not continues or resumed:
            outcome = "continues" if continues else "is taken as unknown, and begins in a frame of its own"
            message = f"the odometry {outcome}"
            if resumed:
                self._report("restart", f"{message} after the restart")
            else:
                self._report("jump", message)
        if self._last is None or not continues:
            self._first_m, self._velocity = pose[:3, 3], np.zeros(3)
        else:
            self._velocity = (pose - self._last)[:3, 3] / max(time - self._last_time, 1e-9)
        self._last, self._last_time, self._is_known, self._misses_pose = pose, time, True, False
        return OdometryState(pose, continues)

    def _awaits_odometry(self, pose: Float[np.ndarray, "4 4"] | None, time: float) -> bool:
        """Return whether the first scans still wait for odometry. If not, `has_odometry` is set by this scan."""
        self._began = time if self._began is None else self._began
        if pose is None and self._expected and time - self._began < FIRST_ODOMETRY_S:
            self._report("wait", "expected odometry, found none yet; scans are left out until it comes")
            return True
        self.has_odometry = pose is not None
        if self._expected and not self.has_odometry:
            self._report(
                "wait over", f"expected odometry, found none for {FIRST_ODOMETRY_S:.0f} s; the map is made without it"
            )
        return False

    def _is_plausible(self, pose: Float[np.ndarray, "4 4"], time: float, resumed: bool) -> bool:
        """Whether a pose can follow the last one: near enough, not reset, not after a long restart."""
        assert self._last is not None
        passed_s = time - self._last_time
        position_m, step_m = pose[:3, 3], (pose - self._last)[:3, 3]
        moved = float(np.linalg.norm(step_m))
        is_at_begin = min(np.linalg.norm(position_m), np.linalg.norm(position_m - self._first_m)) < RESET_M
        moves_on = np.linalg.norm(step_m - self._velocity * passed_s) < moved / 2
        is_reset = is_at_begin and moved > 5 * RESET_M and not moves_on
        is_near = moved <= SLACK_M + FASTEST_M_PER_S * passed_s
        return is_near and not is_reset and (not resumed or passed_s <= RESTART_S)


class ScanClock:
    """Times of scans that never decrease: header times plus an offset, which changes when the sensor's clock changes,
    as two scans in turn show. Scans without a header time, and those two, get a time by their arrival."""

    def __init__(self, report: Report):
        self._report = report
        self._offset = 0.0
        self._last: float | None = None  # time of the last scan by this clock, in seconds
        self._doubtful: float | None = None  # header time of the last scan, if it cannot follow the one before
        self._received = 0.0  # time of arrival of the last scan, in seconds

    def resume(self, time: float, stamp: float, *, received: float) -> None:
        """Continue after a scan of an earlier process: time by this clock, by its header, and of its arrival."""
        self._last, self._received = time, received
        self._offset = time - stamp if _is_time(stamp) else 0.0

    def time(self, stamp: float, received: float, *, is_recorded: bool = False) -> float:
        """Return the time of the next scan, in seconds, from its header time and its time of arrival. In a recording,
        which may be replayed faster, a header may be any time later than the one before."""
        passed_s = max(received - self._received, 0.0)
        expected = received if self._last is None else self._last + passed_s
        time, doubtful = stamp + self._offset, None
        if not _is_time(stamp):
            self._report("time", f"expected the time of a scan in its header, found {stamp:g}; its arrival is used")
            time = expected
        elif self._last is not None and not self._last <= time <= expected + (math.inf if is_recorded else JUMP_S):
            step = f"expected a scan about {passed_s:.1f} s after the last one, found {time - self._last:+.1f} s"
            if self._doubtful is not None and 0 <= stamp - self._doubtful <= passed_s + JUMP_S:
                self._report("clock", f"{step} in its header; from now on times are counted from its arrival")
                self._offset, doubtful = expected - stamp, None
            else:
                self._report("time", f"{step} in its header; its arrival is used")
                doubtful = stamp
            time = expected
        self._doubtful = doubtful
        self._last, self._received = time, received
        return time


def _is_time(stamp: float) -> bool:
    """Whether a header has a time."""
    return math.isfinite(stamp) and stamp > 0


class FixedMounting:
    """Mounting of the sensor: stated by the user, or estimated from the ground in the first `MOUNTING_SCANS` scans."""

    def __init__(self, height: SensorHeight = "auto"):
        """Begin with the height in metres, or "auto" to estimate the mounting."""
        self._mounting = None if isinstance(height, str) else Mounting(float(height))
        self._estimates: list[Mounting | None] = []

    def resume(self, mounting: Mounting | None) -> None:
        """Continue with the mounting of an earlier process, if it had one."""
        self._mounting = mounting or self._mounting

    def add(self, points: Float32[np.ndarray, "n 3"]) -> Mounting | None:
        """Return the mounting for this scan: the given one, or the common one of at most `MOUNTING_SCANS` scans.

        None if none of these scans shows the ground.
        """
        is_known = self._mounting is not None and not self._estimates  # given by the user, or by an earlier process
        if not is_known and len(self._estimates) < MOUNTING_SCANS:
            self._estimates.append(estimate_mounting(points))
            self._mounting = common_mounting(self._estimates)
        return self._mounting
