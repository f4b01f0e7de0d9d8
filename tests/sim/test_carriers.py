"""Carriers of the sensor: height, tilt, speed, stands and reversals."""

import numpy as np
import pytest

from sglpr_jax.sim.carriers import CARRIERS, HAND_TILT_DEG, STEPS_HZ, TILT_DEG, VEHICLE, body_tilt
from sglpr_jax.sim.drive import PlanarPath, poses_on, speeds
from sglpr_jax.sim.ground import Relief
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording
from sglpr_jax.sim.repeating import simulate_repeating
from sglpr_jax.sim.routes import travelled
from sglpr_jax.sim.sensor import Sensor

PLAIN = Relief(np.zeros(1), np.ones((1, 2)), np.zeros(1))
NARROW = Sensor(elevations_deg=(10.0, -10.0, -20.0), azimuth_steps=64, azimuths_deg=(-60.0, 60.0), min_range_m=0.5)
straight = PlanarPath(np.stack([np.arange(0, 800, 0.5), np.zeros(1600)], axis=1), np.zeros(1600), np.arange(1600) / 10)


def test_the_body_tilts_on_the_spot():
    times = np.linspace(0, 400, 2000)
    tilt = body_tilt(np.random.default_rng(0), times)
    np.testing.assert_allclose(np.degrees(tilt.std(axis=0)), TILT_DEG, rtol=0.2)
    assert np.abs(np.diff(tilt, axis=0)).max() < np.abs(tilt).max() / 4  # it takes about a second
    xy, yaw = np.zeros((2000, 2)), np.full(2000, 0.7)
    level, tilted = (poses_on(PLAIN, xy, yaw, height_m=2.0, tilt=t) for t in (None, tilt))
    np.testing.assert_array_equal(level[:, :3, 3], tilted[:, :3, 3])
    turn = level[:, :3, :3].transpose(0, 2, 1) @ tilted[:, :3, :3]
    np.testing.assert_allclose(turn[:, 0, 2], tilt[:, 0], atol=1e-3)  # nose down lifts what lies ahead
    np.testing.assert_allclose(turn[:, 2, 1], tilt[:, 1], atol=1e-3)


def test_a_hand_tilts_and_bobs_with_its_steps():
    times = np.linspace(0, 60, 1200)
    tilt, height_m, left = CARRIERS["handheld"].motion(np.random.default_rng(0), times, height_m=1.0)
    assert not np.any(left)
    degrees = np.degrees(np.abs(tilt))
    assert 11 < degrees.max() <= HAND_TILT_DEG and (degrees.max(axis=1) > 5).mean() > 0.5
    np.testing.assert_allclose(np.quantile(height_m, [0, 0.5, 1]), [1.36, 1.4, 1.44], atol=0.01)
    sways = np.diff(np.sign(height_m - 1.4)) > 0
    assert abs(sways.sum() / 60 - STEPS_HZ) < 0.2
    poses = poses_on(PLAIN, np.zeros((1200, 2)), np.zeros(1200), height_m=height_m, tilt=tilt)
    np.testing.assert_allclose(poses[:, 2, 3], height_m)


def carried(name: str, scans: int = 40, **more):
    return simulate_repeating("garage", scans=scans, seed=2, sensor=NARROW, carrier=CARRIERS[name], **more)


def xyz(recording: SimulatedRecording) -> np.ndarray:
    return recording.poses.world_from_lidar[:, :3, 3]


def tilts_deg(recording) -> np.ndarray:
    """Angle between the z axis of the sensor and the vertical, in degrees."""
    return np.degrees(np.arccos(recording.poses.world_from_lidar[:, 2, 2].clip(-1, 1)))


@pytest.mark.parametrize(
    ("name", "height_m", "bob_m", "tilt_deg"),
    [("backpack", 1.8, 0.03, (3.0, 7.1)), ("handheld", 1.4, 0.04, (9.0, 21.3)), ("cart", 0.6, 0.0, (0.0, 0.0))],
)
def test_a_carrier_has_its_height_and_tilt(name, height_m, bob_m, tilt_deg):
    recording = carried(name)
    assert np.abs(xyz(recording)[:, 2] - height_m).max() <= bob_m + 1e-9
    assert tilt_deg[0] <= tilts_deg(recording).max() <= tilt_deg[1] + 1e-6
    assert recording.mounting is not None and recording.mounting.height_m == height_m


@pytest.mark.parametrize("name", ("backpack", "handheld", "cart"))
def test_a_carrier_has_its_speed(name):
    slowest, fastest = CARRIERS[name].speed_mps or (0.0, 0.0)
    recording = carried(name)
    length = travelled(xyz(recording)[:, :2])[-1]
    assert 0.75 * slowest < length / np.ptp(recording.poses.times) < 1.25 * fastest


@pytest.mark.parametrize(("name", "rate_hz"), [("backpack", 2.0), ("handheld", 5.0)])
def test_a_carrier_has_its_rate(name, rate_hz):
    step = np.median(np.diff(carried(name, scans=400).poses.times))
    assert np.isclose(1 / step, rate_hz, rtol=0.3)
    assert np.diff(carried(name, scans=400, rate_hz=10.0).poses.times).max() < step


def test_a_sensor_in_a_hand_may_see_a_sector():
    points, _ = carried("handheld").render(5)
    assert len(points) > 20 and np.isfinite(points).all()
    assert np.abs(np.degrees(np.arctan2(points[:, 1], points[:, 0]))).max() < 61


def test_a_backpack_sways_sideways():
    motion = CARRIERS["backpack"].motion(np.random.default_rng(0), np.linspace(0, 30, 600), height_m=1.0)
    assert 0.03 < np.abs(motion.left).max() <= 0.04
    assert np.corrcoef(motion.left, motion.tilt[:, 1])[0, 1] < -0.99


def test_a_car_stands_and_reverses():
    path = CARRIERS["stop-and-reverse"].halted(np.random.default_rng(1), straight, poses=7)
    speed = speeds(path)
    assert len(path.times) % 7 == 0 and np.all(np.diff(path.times) > 0)
    np.testing.assert_allclose(path.xy[[0, -1], 0], straight.xy[[0, -1], 0], atol=3)
    stands = runs_of(np.abs(speed) < 0.01, path.times)
    assert len(stands) > 3 and 5 < stands.max() < 61
    backwards = np.diff(path.xy[:, 0]) < 0
    reversals = runs_of(backwards, path.times)
    metres = -np.diff(path.xy[:, 0])[backwards].sum() / len(reversals)
    assert len(reversals) >= 2 and 5 < metres < 15
    assert (speed[1:-1] < -1).any() and speed.max() < 6
    assert np.abs(np.diff(speed)).max() < 0.3
    np.testing.assert_array_equal(path.yaw, 0)


def runs_of(mask: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Duration of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return np.array([times[stop - 1] - times[start] for start, stop in zip(edges[::2], edges[1::2], strict=True)])


def test_poses_of_a_car_that_reverses_keep_their_heading():
    recording = carried("stop-and-reverse", scans=400)
    step = np.diff(xyz(recording)[:, :2], axis=0)
    forward = (step * recording.poses.world_from_lidar[:-1, :2, 0]).sum(axis=1)
    assert (forward < -0.1).any() and (np.abs(forward) < 0.01).sum() > 5 and np.median(forward) > 0.1
    assert np.linalg.norm(step, axis=1).max() < 4


def test_a_vehicle_is_the_default_and_does_not_halt():
    default, vehicle = simulate_repeating("garage", scans=20, seed=2, sensor=NARROW), carried("vehicle", scans=20)
    np.testing.assert_array_equal(default.poses.world_from_lidar, vehicle.poses.world_from_lidar)
    assert VEHICLE.halted(np.random.default_rng(0), straight, poses=10) is straight
    assert tilts_deg(default).max() < 4 * TILT_DEG


def test_a_carrier_in_a_town_has_its_height():
    options = {"scans": 12, "sensor": NARROW}
    backpack = simulate_recording("03", carrier=CARRIERS["backpack"], **options)
    hand = simulate_recording("03", handheld=True, **options)
    np.testing.assert_allclose(xyz(backpack)[:, :2], xyz(hand)[:, :2], atol=0.1)
    assert 0.3 < np.median(xyz(backpack)[:, 2] - xyz(hand)[:, 2]) < 0.5
