"""The loops of a drive do not depend on its speed, on the rate of the sensor, or on the direction of its x axis."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.data.recording import Record
from sglpr_jax.data.views import rotated
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.se3 import inverse, transform, yaw_of
from sglpr_jax.sim.repeating import simulate_repeating
from sglpr_jax.sim.sensor import Sensor

SCANS = 160
SENSOR = Sensor(elevations_deg=tuple(np.linspace(10, -24, 24)), azimuth_steps=480)
ANGLE = np.radians(137.0)
POSE_M, POSE_DEG = 1.5, 6.0
"""Maximum error of a right pose."""


@dataclasses.dataclass(frozen=True)
class Described:
    """A drive of one and a half laps, with the description of each scan, as it is and turned by `ANGLE`."""

    poses: np.ndarray
    times: np.ndarray
    seen: list[Seen]
    turned: list[Seen]

    def loops(
        self, rows: Sequence[int], *, times: Callable[[np.ndarray], np.ndarray] | None, turned: bool = False
    ) -> tuple[set[int], list[str]]:
        """Scans that are queries of loops between these scans, and errors of the loops that are wrong."""
        detector = LoopDetector(sglpr_jax.load("sglpr"))
        clock = None if times is None else times(self.times)
        for row in rows:
            seen = (self.turned if turned else self.seen)[row]
            detector.add_seen(seen, time=None if clock is None else float(clock[row]))
        poses, wrong = self.poses @ transform(0.0, 0.0, -ANGLE if turned else 0.0), []
        for loop in detector.loops:
            query, match = rows[loop.query], rows[loop.match]
            error = inverse(inverse(poses[match]) @ poses[query]) @ loop.match_from_query
            metres, degrees = float(np.linalg.norm(error[:2, 3])), abs(float(np.degrees(yaw_of(error))))
            if metres > POSE_M or degrees > POSE_DEG:
                wrong.append(f"{query} to {match}: {metres:.2f} m, {degrees:.1f} degrees")
        return {rows[loop.query] for loop in detector.loops}, wrong


@pytest.fixture(scope="module")
def described() -> Described:
    drive = simulate_repeating("campus", scans=SCANS, sensor=SENSOR, revisit="same")
    finder, seen = LoopDetector(sglpr_jax.load("sglpr")).finder, ([], [])
    for i in range(SCANS):
        for found, angle in zip(seen, (0.0, ANGLE), strict=True):
            found.append(finder.seen(Record(points=rotated(drive.points(i), angle), mounting=drive.mounting)))
    return Described(drive.poses.world_from_lidar, drive.times, *seen)


EVERY = tuple(range(SCANS))


def as_given(times: np.ndarray) -> np.ndarray:
    return times


@pytest.fixture(scope="module")
def expected(described) -> set[int]:
    """Queries of the drive as it is. It repeats its first third."""
    found, _ = described.loops(EVERY, times=as_given)
    assert len(found) > SCANS / 5
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rows", "options"),
    [
        (EVERY, {"times": lambda times: 4 * times}),
        (EVERY, {"times": None}),
        (tuple(np.repeat(EVERY, 2).tolist()), {"times": None}),
        (EVERY[::2], {"times": as_given}),
        (EVERY, {"times": as_given, "turned": True}),
    ],
    ids=["slower", "without times", "twice without times", "every second", "turned"],
)
def test_the_loops_of_a_drive_stay_the_same_and_are_right(described, expected, rows, options):
    found, wrong = described.loops(rows, **options)
    possible = expected & set(rows)
    assert len(found & possible) >= 0.95 * len(possible), f"missing: {sorted(possible - found)}"
    assert not wrong
