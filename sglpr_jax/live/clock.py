"""Times of a live map that never go back, whatever the headers say."""

import math

from sglpr_jax.live.report import Report

JUMP_S = 60.0
"""Minimum step of the headers' times beyond the time that has passed that counts as a change of the clock, in
seconds."""


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
        """Continue after a scan of an earlier process.

        Arguments:
          time: Time of the last scan by this clock, in seconds.
          stamp: Time of its header.
          received: Time at which it arrived, by `time.monotonic()` of this process.
        """
        self._last, self._received = time, received
        self._offset = time - stamp if _is_time(stamp) else 0.0

    def time(self, stamp: float, received: float) -> float:
        """Return the time of the next scan, in seconds, which is not before that of the previous one.

        Arguments:
          stamp: Time of the header, in seconds.
          received: Time at which the scan arrived, by `time.monotonic()`.
        """
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
