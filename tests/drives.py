"""Drives for the tests: one that is simulated, and synthetic ones with loops that a detector might find on them."""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sglpr_jax
from sglpr_jax.data.scan_stream import only
from sglpr_jax.loops.closure import LoopClosure, planar_loop
from sglpr_jax.models.weights import Params
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.se3 import inverse, transform, yaw_of
from sglpr_jax.sim import recording
from sglpr_jax.sim.drive import TimedPoses
from sglpr_jax.sim.recording import SimulatedRecording
from sglpr_jax.sim.sensor import Sensor

SCANS = 240
SENSOR = Sensor(elevations_deg=tuple(np.linspace(2, -24, 32)), azimuth_steps=600)

PASS = 20
"""Scans of `street` in each direction."""
LOOP_COVARIANCE = np.diag([0.1, 0.1, np.radians(0.3)]) ** 2


@functools.cache
def simulated_drive() -> SimulatedRecording:
    """240 scans, about 1.8 m apart; the drive comes back the other way. Each scan is rendered once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "KEPT_SCANS", SCANS)
        return recording.simulate_recording("08", scans=SCANS, sensor=SENSOR, seed=3)


@pytest.fixture(scope="session")
def drive() -> SimulatedRecording:
    """`simulated_drive`."""
    return simulated_drive()


def part_of_drive(rows: Sequence[int], name: str = "08") -> SimulatedRecording:
    """Some scans of the drive as a recording of their own."""
    whole, rows = simulated_drive(), list(rows)
    poses = TimedPoses(whole.poses.world_from_lidar[rows], whole.poses.times[rows])
    return dataclasses.replace(only(whole, rows), name=name, rows=None, poses=poses)


@pytest.fixture(scope="session")
def params() -> Params:
    return sglpr_jax.load("sglpr-small")


@pytest.fixture(scope="session")
def street() -> SimulatedRecording:
    """40 scans, 3.5 m apart: a street, and 40 s later the same street the other way."""
    return part_of_drive((*range(0, 2 * PASS, 2), *range(SCANS - 2 * PASS, SCANS, 2)))


@pytest.fixture(scope="session")
def revisit(drive) -> tuple[int, int]:
    """A query and a match within 3 m of each other, half a minute apart or more."""
    apart = np.linalg.norm(drive.positions[:, None] - drive.positions[None], axis=2)
    apart[np.abs(np.subtract.outer(drive.times, drive.times)) < 30] = np.inf
    query, match = np.unravel_index(apart.argmin(), apart.shape)
    assert apart[query, match] < 3
    return int(max(query, match)), int(min(query, match))


def along(corners: Sequence[Sequence[float]], step_m: float = 1.0) -> np.ndarray:
    """Poses (n, 4, 4) along a polyline, heading in the direction of travel."""
    poses = []
    for start, end in zip(np.array(corners, float)[:-1], np.array(corners, float)[1:], strict=True):
        yaw = np.arctan2(*(end - start)[::-1])
        length = np.linalg.norm(end - start)
        poses += [transform(*(start + way * (end - start) / length), yaw) for way in np.arange(0, length, step_m)]
    return np.stack(poses)


def drifted(poses: np.ndarray, *, percent: float, deg_per_100m: float, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Odometry of a drive: too long by `percent`, turned by `deg_per_100m`, both with `noise` times as much noise."""
    rng = np.random.default_rng(seed)
    steps = inverse(poses[:-1]) @ poses[1:]
    metres = np.linalg.norm(steps[:, :3, 3], axis=1)
    scale = 1 + percent / 100 * (1 + noise * rng.normal(size=len(steps)))
    turn = np.radians(deg_per_100m) * (metres / 100 + noise * rng.normal(size=len(steps)) * np.sqrt(metres / 100))
    found = [poses[0]]
    for step, factor, angle in zip(steps, scale, turn, strict=True):
        step = step.copy()
        step[:3, 3] *= factor
        found.append(found[-1] @ step @ transform(0.0, 0.0, angle))
    return np.stack(found)


def loop_at(query: int, match: int, match_from_query: np.ndarray, rng: np.random.Generator) -> LoopClosure:
    """A loop of this pose in the plane, with noise of its covariance."""
    pose = match_from_query @ transform(*rng.multivariate_normal(np.zeros(3), LOOP_COVARIANCE))
    alignment = BevRegistration(*pose[:2, 3], yaw_of(pose), LOOP_COVARIANCE, 0.9, 0.3)
    return planar_loop(query, match, alignment, probability=0.999)


def true_loops(poses: np.ndarray, *, every: int = 1, within_m: float = 5.0, exclude: int = 100) -> list[LoopClosure]:
    """The nearest earlier frame of each revisit, with its true pose."""
    rng, found = np.random.default_rng(1), []
    for query in range(exclude, len(poses), every):
        apart = np.linalg.norm(poses[: query - exclude + 1, :2, 3] - poses[query, :2, 3], axis=1)
        match = int(apart.argmin())
        if apart[match] <= within_m:
            found.append(loop_at(query, match, inverse(poses[match]) @ poses[query], rng))
    return found


def wrong_loops(
    poses: np.ndarray, moved: Sequence[float], queries: Sequence[int], *, exclude: int = 10
) -> list[LoopClosure]:
    """Loops that take the place at each query for the one that is farther on by the vector `moved`.

    The match is the earlier frame next to that place. The pose is what two scans of places alike give.
    """
    rng, found = np.random.default_rng(2), []
    for query in queries:
        alike = poses[query].copy()
        alike[:2, 3] += moved
        match = int(np.linalg.norm(poses[: query - exclude, :2, 3] - alike[:2, 3], axis=1).argmin())
        found.append(loop_at(query, match, inverse(poses[match]) @ alike, rng))
    return found


def town() -> np.ndarray:
    """Poses of 1.9 km about blocks, partly on streets of before, in both directions."""
    a = [(0, 0), (200, 0), (200, 150), (0, 150), (0, 0), (120, 0), (120, 150), (120, 300), (0, 300), (0, 150)]
    return along([*a, (200, 150), (200, 0), (60, 0)], 2.0)


def rooms() -> np.ndarray:
    """Poses in a room of 5 m and in one of the same shape, 8 m on."""
    room = [(1.0, 1.0), (4.0, 1.0), (4.0, 4.0), (1.0, 4.0), (1.0, 1.0)]
    first = [(0.0, 0.0), *room]
    return along([*first, *((x + 8.0, y) for x, y in first), (8.0, 1.0)], 0.25)


def error_of(found: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    apart = inverse(expected) @ found
    return float(np.linalg.norm(apart[:3, 3])), float(np.degrees(Rotation.from_matrix(apart[:3, :3]).magnitude()))
