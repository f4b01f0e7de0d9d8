"""Input of a live map: time, sensor mounting and odometry of each scan, whatever the headers and the robot do."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from sglpr_jax.data.choices import SensorHeight
from sglpr_jax.data.mounting import Mounting, common_mounting, estimate_mounting
from sglpr_jax.live.node_messages import Report
from sglpr_jax.se3 import inverse

JUMP_S = 60.0
"""Minimum step of the headers' times beyond the time that has passed that counts as a change of the clock, in
seconds."""
SCANS = 11
"""Number of scans from which the mounting is estimated."""
FASTEST_M_PER_S, SLACK_M = 60.0, 1.0
"""Maximum speed of a vehicle, and an additional distance between two scans, in metres."""
RESTART_S = 60.0
"""Maximum time without a scan after which the odometry may continue, in seconds."""
RESET_M = 0.2
"""Distance from the origin, in metres, within which odometry begins. A pose that gets there from more than five times
this distance was reset."""
HOLD_S = 2.0
"""Time without odometry for which scans are left out, in seconds. Later scans are added at an unknown place."""
WAIT_S = 10.0
"""Time for which the first scans wait for odometry that was asked for, in seconds."""


class OdometryState(NamedTuple):
    """Pose of a scan for the detector."""

    pose: Float[np.ndarray, "4 4"] | None
    continues: bool
    """Whether the motion since the last scan is known."""


class Continuity:
    """Decides for each scan whether its odometry continues. The first scan decides whether the map has odometry."""

    def __init__(self, report: Report, *, expected: bool):
        """Begin a map. `expected` says that odometry was asked for, so that the first scans wait for it."""
        self._report, self._expected = report, expected
        self._has_odometry: bool | None = None
        """None until the first scan decides."""
        self._began: float | None = None
        """Time of the first scan, in seconds."""
        self._last: Float[np.ndarray, "4 4"] | None = None
        """Last pose by odometry."""
        self._last_time = 0.0
        """Time of `_last`, in seconds."""
        self._last_is_current = True
        """Whether `_last` is the pose of the previous scan."""
        self._resumed = False
        """Whether the next scan is the first one after a restart."""

    def resume(self, pose: Float[np.ndarray, "4 4"] | None, time: float, *, known: bool = True) -> None:
        """Continue a map of an earlier process, whose last scan had this pose at this time.

        With `known=False`, the motion up to that scan was unknown, so its pose may be an old one.
        """
        self._has_odometry, self._last, self._last_time = pose is not None, pose, time
        self._last_is_current, self._resumed = known, True

    def add(self, pose: Float[np.ndarray, "4 4"] | None, time: float) -> OdometryState | None:
        """Return the state of the next scan, or None if the scan is to be left out. Times do not decrease."""
        if self._has_odometry is None and self._waits(pose, time):
            return None
        resumed, self._resumed = self._resumed, False
        if not self._has_odometry:
            if pose is not None:
                self._report("odometry", "expected no odometry, because the map began without it; it is not used")
            if resumed:
                self._report("restart", "the way since the restart's last scan is unknown")
            return OdometryState(None, not resumed)
        if pose is None:
            return self._without_pose(time, resumed)
        continues = self._last is None or (self._last_is_current and self._can_follow(pose, time, resumed))
        if not continues or resumed:
            what = "continues" if continues else "is taken as unknown, and begins in a frame of its own"
            self._report("restart" if resumed else "jump", f"the odometry {what}{' after the restart' * resumed}")
        self._last, self._last_time, self._last_is_current = pose, time, True
        return OdometryState(pose, continues)

    def _waits(self, pose: Float[np.ndarray, "4 4"] | None, time: float) -> bool:
        """Whether the first scans still wait for odometry. Otherwise decides whether the map has odometry."""
        self._began = time if self._began is None else self._began
        if pose is None and self._expected and time - self._began < WAIT_S:
            self._report("wait", "expected odometry, found none yet; scans are left out until it comes")
            return True
        self._has_odometry = pose is not None
        if self._expected and not self._has_odometry:
            self._report("wait over", f"expected odometry, found none for {WAIT_S:.0f} s; the map is made without it")
        return False

    def _without_pose(self, time: float, resumed: bool) -> OdometryState | None:
        """State of a scan without odometry in a map that has odometry."""
        passed = time - self._last_time
        if not resumed and self._last_is_current and passed < HOLD_S:
            return self._report("hold", "expected odometry at a scan, found none; the scan is left out")
        self._report("stopped", f"expected odometry, found none for {passed:.0f} s; loops are found by scans")
        self._last_is_current = False
        return OdometryState(np.eye(4) if self._last is None else self._last, False)

    def _can_follow(self, pose: Float[np.ndarray, "4 4"], time: float, resumed: bool) -> bool:
        """Whether a pose can follow the last one: near enough, not reset to the origin, and not after a long stop."""
        assert self._last is not None
        passed = time - self._last_time
        moved = float(np.linalg.norm((inverse(self._last) @ pose)[:3, 3]))
        is_reset = float(np.linalg.norm(pose[:3, 3])) < RESET_M and moved > 5 * RESET_M
        is_near = moved <= SLACK_M + FASTEST_M_PER_S * passed
        return is_near and not is_reset and (not resumed or passed <= RESTART_S)


class Clock:
    """Adds an offset to the times of the headers. The offset changes when the clock of the sensor changes.

    Scans without a time, and the first scan after a change, get the time at which they arrived.
    """

    def __init__(self, report: Report):
        self._report = report
        self._offset = 0.0
        self._last: float | None = None
        self._received = 0.0

    def resume(self, time: float, stamp: float, *, received: float) -> None:
        """Continue after a scan of an earlier process: its time by this clock, by its header, and of its arrival."""
        self._last, self._received = time, received
        self._offset = time - stamp if _is_time(stamp) else 0.0

    def time(self, stamp: float, received: float) -> float:
        """Return the time of the next scan, in seconds, which is not before that of the previous one."""
        passed = max(received - self._received, 0.0)
        expected = received if self._last is None else self._last + passed
        time = stamp + self._offset
        if not _is_time(stamp):
            self._report("time", f"expected the time of a scan in its header, found {stamp:g}; its arrival is used")
            time = expected
        elif self._last is not None and not self._last <= time <= expected + JUMP_S:
            self._report(
                "clock",
                f"expected a scan about {passed:.1f} s after the last one, found {time - self._last:+.1f} s in its "
                "header; from now on times are counted from its arrival",
            )
            self._offset, time = expected - stamp, expected
        self._last, self._received = time, received
        return time


def _is_time(stamp: float) -> bool:
    return math.isfinite(stamp) and stamp > 0


class FirstScans:
    """Estimates the mounting from the ground in the first scans. Then it is fixed."""

    def __init__(self, height: SensorHeight = "auto"):
        """Begin with the height that the user gave, in metres, or without a mounting."""
        self._mounting = None if isinstance(height, str) else Mounting(float(height))
        self._estimates: list[Mounting | None] = []

    def resume(self, mounting: Mounting | None) -> None:
        """Continue with the mounting of an earlier process, if it had one."""
        self._mounting = mounting or self._mounting

    def add(self, points: Float32[np.ndarray, "n 3"]) -> Mounting | None:
        """Return the mounting at the next scan, or None if the scans so far do not show the ground."""
        is_known = self._mounting is not None and not self._estimates
        if not is_known and len(self._estimates) < SCANS:
            self._estimates.append(estimate_mounting(points))
            self._mounting = common_mounting(self._estimates)
        return self._mounting
