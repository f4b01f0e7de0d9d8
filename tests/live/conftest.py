"""A simulated street that is driven twice, and reports as a list."""

import dataclasses

import pytest
from drives import PASS, params, street  # noqa: F401

from sglpr_jax.live.data_types import LiveFrame

SCANS = 2 * PASS
BEGIN = 1_700_000_000.25
"""Time of the first scan, in seconds."""


drive = street


class Said(list):
    """A `Report` that keeps the kind and the text of each event."""

    def __call__(self, kind: str, text: str) -> None:
        self.append((kind, text))

    @property
    def kinds(self) -> list[str]:
        return [kind for kind, _ in self]

    def of(self, kind: str) -> list[str]:
        """Texts of the events of a kind."""
        return [text for one, text in self if one == kind]


@pytest.fixture
def said() -> Said:
    return Said()


def live_frame(drive, i: int, *, pose=None, time: float | None = None, received: float | None = None) -> LiveFrame:
    """Scan `i` of a drive as it arrives, at its own pace."""
    scan = dataclasses.replace(drive.scan(i), name=f"scan {i}", mounting=None)
    time = BEGIN + float(drive.times[i]) if time is None else time
    return LiveFrame(scan, time, pose, float(drive.times[i]) if received is None else received)
