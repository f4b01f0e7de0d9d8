"""A simulated town that is driven through twice, in opposite directions, and two laps of an ellipse by odometry."""

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sglpr_jax.loops.closure import Loop
from sglpr_jax.loops.comparison import Candidate, Comparer
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.registration.bev_alignment import Alignment
from sglpr_jax.se3 import inverse, transform, yaw_of
from sglpr_jax.sim import recording
from sglpr_jax.sim.recording import SimulatedRecording
from sglpr_jax.sim.sensor import Sensor

SCANS = 240
LAPS_FRAMES = 120
LOOP_COVARIANCE = np.diag([0.1, 0.1, 0.5, *np.radians([2, 2, 0.3])]) ** 2
SENSOR = Sensor(elevations_deg=tuple(np.linspace(2, -24, 32)), azimuth_steps=600)


@pytest.fixture(scope="session")
def drive() -> SimulatedRecording:
    """240 scans, about 1.8 m apart; it comes back the other way. Each scan is rendered once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "KEPT_SCANS", SCANS)
        return recording.simulate_recording("08", scans=SCANS, sensor=SENSOR, seed=3)


@pytest.fixture(scope="session")
def revisit(drive) -> tuple[int, int]:
    """A query and a match within 3 m of each other, half a minute apart or more."""
    apart = np.linalg.norm(drive.positions[:, None] - drive.positions[None], axis=2)
    apart[np.abs(np.subtract.outer(drive.times, drive.times)) < 30] = np.inf
    query, match = np.unravel_index(apart.argmin(), apart.shape)
    assert apart[query, match] < 3
    return int(max(query, match)), int(min(query, match))


@pytest.fixture
def compare_only(monkeypatch) -> Callable[[Mapping[int, tuple[int, np.ndarray]]], None]:
    """`compare_only({query: (match, match_from_query)})` replaces the comparison of images: each query has this match,
    with clear images, and with the deviation of this pose from the motion."""

    def only(pairs: Mapping[int, tuple[int, np.ndarray]]) -> None:
        def candidates(self, query, fits, image_of, **_) -> list[Candidate]:
            if query.frame not in pairs:
                return []
            match, pose = pairs[query.frame]
            planar = np.array([[*pose[:2, 3], yaw_of(pose)]])
            (deviation,) = self.deviations(query.frame, np.array([match]), planar)
            alignment = Alignment(*planar[0], np.diag([0.05, 0.05, 0.005]) ** 2, 0.8, 0.3)
            return [Candidate(query.frame, match, alignment, Evidence.of(0.3, 0.1, deviation, 3.0))]

        monkeypatch.setattr(Comparer, "candidates", candidates)

    return only


@pytest.fixture(scope="session")
def two_laps() -> np.ndarray:
    """True poses on an ellipse that is driven around twice, up and down a hill."""
    angle = np.linspace(0, 4 * np.pi, LAPS_FRAMES)
    yaw = np.arctan2(60 * np.cos(angle), -90 * np.sin(angle))
    poses = np.stack([transform(90 * np.cos(a), 60 * np.sin(a), y) for a, y in zip(angle, yaw, strict=True)])
    poses[:, 2, 3] = 3 * np.sin(angle)
    return poses


@pytest.fixture(scope="session")
def two_laps_odometry(two_laps) -> np.ndarray:
    """1 % too long, turned by half a degree a frame, with noise."""
    rng = np.random.default_rng(0)
    steps = inverse(two_laps[:-1]) @ two_laps[1:]
    found = [two_laps[0]]
    for step in steps:
        noise = np.eye(4)
        noise[:3, :3] = Rotation.from_rotvec(np.radians([0, 0, 0.05]) + rng.normal(scale=1e-3, size=3)).as_matrix()
        noise[:3, 3] = 0.01 * step[:3, 3]
        found.append(found[-1] @ step @ noise)
    return np.stack(found)


@pytest.fixture(scope="session")
def second_lap_loops(two_laps) -> tuple[Loop, ...]:
    """The second time around sees the first, to a decimetre."""
    rng = np.random.default_rng(1)
    found = []
    for query in range(64, LAPS_FRAMES, 4):
        match = int(np.linalg.norm(two_laps[:50, :3, 3] - two_laps[query, :3, 3], axis=1).argmin())
        pose = inverse(two_laps[match]) @ two_laps[query] @ transform(*rng.normal(scale=0.05, size=2), 0.002)
        found.append(Loop(query, match, pose, LOOP_COVARIANCE, 0.99))
    return tuple(found)
