"""Storeys above one another: heights, ramps, and scans that show only their own storey."""

import numpy as np
import pytest

from sglpr_jax.sim.levels import Levels
from sglpr_jax.sim.recording import SimulatedRecording
from sglpr_jax.sim.repeating import simulate_repeating
from sglpr_jax.sim.routes import Revisit
from sglpr_jax.sim.sceneries.storeys import HALF_M, RAMP_M, TURN_M, WIDE_M, storeys
from sglpr_jax.sim.sensor import Sensor

SENSOR = Sensor(elevations_deg=(10.0, 2.0, -2.0, -12.0), azimuth_steps=320, min_range_m=0.5, range_noise_m=0.0)
LEVELS = Levels(rise_m=3.0, pitch_m=50.0, ramp_y_m=10.0, top_m=0.0, foot_m=20.0)


def drive(revisit: Revisit = "none", scans: int = 150) -> SimulatedRecording:
    return simulate_repeating("storeys", scans=scans, seed=3, sensor=SENSOR, revisit=revisit)


def xyz(recording: SimulatedRecording) -> np.ndarray:
    return recording.poses.world_from_lidar[:, :3, 3]


def on_ramp(recording: SimulatedRecording) -> np.ndarray:
    return xyz(recording)[:, 1] > WIDE_M + HALF_M - 1


def heights(recording: SimulatedRecording) -> np.ndarray:
    """Height of the storey of each scan that is on no ramp, in metres."""
    return np.round(xyz(recording)[~on_ramp(recording), 2] - SENSOR.height_m, 2)


def test_a_path_up_and_down_a_ramp():
    x = np.concatenate([np.full(12, 22.0), np.arange(22, -2, -0.5), np.arange(-2, 22, 0.5), np.full(12, 22.0)])
    y = np.concatenate([np.arange(12.0), np.full(96, 12.0), np.arange(12.0)[::-1]])
    there, ground, slope = LEVELS.along(np.stack([x, y], axis=1))
    assert ground[0] == ground[-1] == 0 and ground.max() == 3
    assert np.abs(np.diff(ground)).max() < 0.15
    assert set(np.round(there[:, 1] - y)) == {0, 50}
    np.testing.assert_array_equal(there[:, 0], x)
    measured = np.gradient(ground[12:60], x[12:60])
    np.testing.assert_allclose(slope[13:59, 0], measured[1:-1], atol=0.01)


def test_a_path_beside_the_ramps_stays_on_its_storey():
    line = np.stack([np.concatenate([np.arange(20.0), np.arange(20.0)[::-1]]), np.full(40, 5.0)], axis=1)
    there, ground, slope = LEVELS.along(line)
    np.testing.assert_array_equal(there, line)
    assert not ground.any() and not slope.any()


def test_up_through_all_storeys():
    recording = drive()
    storey = np.unique(heights(recording))
    rise = np.diff(storey)
    assert 3 <= len(storey) <= 6 and storey[0] == 0
    np.testing.assert_allclose(rise, rise[0], atol=0.02)
    assert 3.0 <= rise[0] <= 3.6
    assert np.all(np.diff(heights(recording)) >= 0)
    lowest, highest = (xyz(recording)[~on_ramp(recording)][heights(recording) == z, :2] for z in storey[[0, -1]])
    apart = np.linalg.norm(lowest[:, None] - highest, axis=2).min(axis=1)
    assert np.median(apart) < 2  # each storey is driven along the same way


def test_two_laps_of_the_lowest_storey_and_then_up():
    recording = drive("same")
    shares = [np.mean(heights(recording) == z) for z in np.unique(heights(recording))]
    assert shares[0] > 1.5 * shares[1]
    assert np.all(np.diff(heights(recording)) >= 0)


def test_up_and_down_again():
    z = heights(drive("opposite"))
    top = np.flatnonzero(z == z.max())
    assert z[0] == z[-1] == 0
    assert np.all(np.diff(z[: top[-1]]) >= 0) and np.all(np.diff(z[top[0] :]) <= 0)


@pytest.mark.parametrize("revisit", ("none", "opposite"))
def test_a_car_climbs_and_tilts_on_ramps_without_jumps(revisit):
    recording = drive(revisit, scans=1500)
    poses = recording.poses.world_from_lidar
    step = np.diff(poses[:, :3, 3], axis=0)
    assert np.linalg.norm(step, axis=1).max() < 2 and np.abs(step[:, 2]).max() < 0.25
    ahead = (poses[1:, :3, 0] + poses[:-1, :3, 0]) / 2
    climbs = np.abs(step[:, 2]) > 0.02
    assert climbs.sum() > 20
    climb = np.degrees(np.arcsin(step[climbs, 2] / np.linalg.norm(step[climbs], axis=1)))
    assert np.abs(climb - np.degrees(np.arcsin(ahead[climbs, 2]))).max() < 3
    assert 4 < np.abs(climb).max() < 16


@pytest.mark.slow
def test_scans_of_all_storeys_show_the_same_walls_at_the_height_of_their_storey():
    recording = drive()
    size = np.array([np.ptp(xyz(recording)[:, 0]) + 2 * TURN_M, HALF_M + WIDE_M + RAMP_M + 3.0])
    rows = np.flatnonzero(~on_ramp(recording))
    for i in rows[:: len(rows) // 3]:
        points, _ = recording.render(int(i))
        pose = recording.poses.world_from_lidar[i]
        there = points[:, :3] @ pose[:3, :3].T + pose[:3, 3]
        assert np.all(np.ptp(there[:, :2], axis=0) < size + 2)
        assert there[:, 0].min() > -TURN_M - 0.5 and there[:, 1].min() > -HALF_M - 0.5
        above = there[:, 2] - (pose[2, 3] - SENSOR.height_m)
        assert -0.2 < above.min() < 0.2 and above.max() < 3.5


def test_storeys_have_walls_and_pillars_alike_and_cars_of_their_own():
    site = storeys(np.random.default_rng(2), 700.0, False)
    assert site.levels is not None
    tables = []
    for k in range(3):
        low = k * site.levels.pitch_m - 20
        spots = [spot for spot in site.spots if low < spot.y < low + site.levels.pitch_m]
        tables.append(
            [
                {(round(s.x, 2), round(s.y - low, 2)) for s in spots if (len(s.thing) == 2) == cars}
                for cars in (False, True)
            ]
        )
    (walls, cars), (walls_above, cars_above), _ = tables
    assert walls == walls_above and len(walls) > 10
    assert len(cars & cars_above) == 0 and len(cars) > 20
