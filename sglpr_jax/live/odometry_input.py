"""Input of a live map: time, sensor mounting and odometry of each scan, whatever the headers and the robot do."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from sglpr_jax.data.choices import SensorHeight
from sglpr_jax.data.mounting import Mounting, common_mounting, estimate_mounting
from sglpr_jax.live.messages import Report
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
        self._used: bool | None = None
        self._last: Float[np.ndarray, "4 4"] | None = None
        self._time = 0.0
        """Time of `_last`, in seconds."""
        self._began: float | None = None
        self._known = True
        """Whether the scan before was placed by odometry."""
        self._resumed = False

    def resume(self, pose: Float[np.ndarray, "4 4"] | None, time: float, *, known: bool = True) -> None:
        """Continue a map of an earlier process, whose last scan had this pose at this time.

        With `known=False`, the motion up to that scan was unknown, so its pose may be an old one.
        """
        self._used, self._last, self._time, self._known, self._resumed = pose is not None, pose, time, known, True

    def placed(self, pose: Float[np.ndarray, "4 4"] | None, time: float) -> OdometryState | None:
        """Place the next scan by its odometry, or return None if it is to be left out. Times do not decrease."""
        if self._used is None and not self._decided(pose, time):
            return None
        resumed, self._resumed = self._resumed, False
        if not self._used:
            if pose is not None:
                self._report("odometry", "expected no odometry, because the map began without it; it is not used")
            if resumed:
                self._report("restart", "the way since the restart's last scan is unknown")
            return OdometryState(None, not resumed)
        if pose is None:
            return self._without(time, resumed)
        continues = self._last is None or (self._known and self._continues(pose, time, resumed))
        if not continues or resumed:
            said = "continues" if continues else "is taken as unknown, and begins in a frame of its own"
            self._report("restart" if resumed else "jump", f"the odometry {said}{' after the restart' * resumed}")
        self._last, self._time, self._known = pose, time, True
        return OdometryState(pose, continues)

    def _decided(self, pose: Float[np.ndarray, "4 4"] | None, time: float) -> bool:
        """Decide whether the map has odometry. Returns False while the first scans wait for it."""
        self._began = time if self._began is None else self._began
        if pose is None and self._expected and time - self._began < WAIT_S:
            self._report("wait", "expected odometry, found none yet; scans are left out until it comes")
            return False
        self._used = pose is not None
        if self._expected and not self._used:
            self._report("wait over", f"expected odometry, found none for {WAIT_S:.0f} s; the map is made without it")
        return True

    def _without(self, time: float, resumed: bool) -> OdometryState | None:
        """Place a scan without odometry in a map that has odometry."""
        if not resumed and self._known and time - self._time < HOLD_S:
            self._report("hold", "expected odometry at a scan, found none; the scan is left out")
            return None
        self._report(
            "stopped", f"expected odometry, found none for {time - self._time:.0f} s; loops are found by scans"
        )
        self._known = False
        return OdometryState(np.eye(4) if self._last is None else self._last, False)

    def _continues(self, pose: Float[np.ndarray, "4 4"], time: float, resumed: bool) -> bool:
        """Whether a pose can follow the last one: near enough, not reset to the origin, and not after a long stop."""
        assert self._last is not None
        passed = time - self._time
        moved = float(np.linalg.norm((inverse(self._last) @ pose)[:3, 3]))
        reset = float(np.linalg.norm(pose[:3, 3])) < RESET_M and moved > 5 * RESET_M
        near = moved <= SLACK_M + FASTEST_M_PER_S * passed
        return near and not reset and (not resumed or passed <= RESTART_S)


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
        found = stamp + self._offset
        if not _is_time(stamp):
            self._report("time", f"expected the time of a scan in its header, found {stamp:g}; its arrival is used")
            found = expected
        elif self._last is not None and not self._last <= found <= expected + JUMP_S:
            self._report(
                "clock",
                f"expected a scan about {passed:.1f} s after the last one, found {found - self._last:+.1f} s in its "
                "header; from now on times are counted from its arrival",
            )
            self._offset = expected - stamp
            found = expected
        self._last, self._received = found, received
        return found


def _is_time(stamp: float) -> bool:
    return math.isfinite(stamp) and stamp > 0


class FirstScans:
    """Estimates the mounting from the ground in the first scans. Then it is fixed."""

    def __init__(self, height: SensorHeight = "auto", *, known: Mounting | None = None):
        """Begin with the height that the user gave, in metres, or with the mounting of an earlier process."""
        given = None if isinstance(height, str) else Mounting(float(height))
        self.mounting = known or given
        """Mounting found by now, or None if the scans do not show the ground."""
        self._fixed = self.mounting is not None
        self._found: list[Mounting | None] = []

    def see(self, points: Float32[np.ndarray, "n 3"]) -> Mounting | None:
        """Return the mounting at the next scan."""
        if not self._fixed:
            self._found.append(estimate_mounting(points))
            self.mounting = common_mounting(self._found)
            self._fixed = len(self._found) >= SCANS
        return self.mounting
