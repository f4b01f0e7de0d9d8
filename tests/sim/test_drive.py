"""The eleven routes: which revisits they have, and that a car could drive them; pose files; poses on hills."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from sglpr_jax.files import DataWarning
from sglpr_jax.sim.drive import CARRIERS, PlanarPath, plan_path, poses_on, read_path, scan_rows
from sglpr_jax.sim.ground import draw_relief, relief_height
from sglpr_jax.sim.recording import simulate_repeating
from sglpr_jax.sim.routes import ROLES, plan_walk
from sglpr_jax.sim.sensor import Sensor

LEAST = {"00": 0.12, "02": 0.08, "05": 0.12, "06": 0.1, "07": 0.05, "08": 0.1, "09": 0.03}


def speeds(path: PlanarPath) -> np.ndarray:
    """Speed of the vehicle at each pose, in m/s. It is negative where the vehicle reverses."""
    velocity = np.gradient(path.xy, path.times, axis=0)
    forward = velocity[:, 0] * np.cos(path.yaw) + velocity[:, 1] * np.sin(path.yaw)
    return np.where(forward < 0, -1, 1) * np.linalg.norm(velocity, axis=1)


def revisits(trajectory) -> tuple[float, float, np.ndarray]:
    """Shares of the scans within 3 m of one 30 s older that heads the same and the opposite way; and when."""
    apart = cdist(trajectory.xy, trajectory.xy)
    apart[trajectory.times[:, None] - trajectory.times[None, :] < 30] = np.inf
    heading = np.cos(trajectory.yaw - trajectory.yaw[apart.argmin(1)])
    again = apart.min(1) <= 3
    return np.mean(again & (heading > 0.7)), np.mean(again & (heading < -0.7)), trajectory.times[again]


@pytest.mark.parametrize("name", ROLES)
def test_a_car_could_drive_a_route_which_has_the_revisits_of_its_namesake(name):
    scans = 200
    path = plan_path(np.random.default_rng(0), name, scans=scans)
    same, opposite, when = revisits(PlanarPath(*(values[scan_rows(path, scans)] for values in path)))
    least = LEAST.get(name, 0)
    assert (least <= opposite <= 0.3 and same < 0.02) if name == "08" else (least <= same <= 0.3 and opposite < 0.02)
    assert least or same == 0
    if name in ("06", "07", "09"):
        assert when.min() > 0.6 * path.times[-1]  # they come back at the end
    assert len(path.times) % scans == 0 and path.times[0] == 0
    np.testing.assert_allclose(np.diff(path.times), path.times[1])  # evenly
    assert 0.05 < path.times[1] < 0.25
    speed = speeds(path)
    slowest, mean, fastest = {"01": (13, 22, 30), "04": (11, 15, 20)}.get(name, (2, 8.5, 16))
    assert slowest < speed.min() and speed.max() < fastest and abs(speed.mean() / mean - 1) < 0.35
    assert np.abs(np.diff(speed) / path.times[1]).max() < 4
    step = np.diff(path.xy, axis=0)
    ahead = step / np.linalg.norm(step, axis=1, keepdims=True)
    heading = np.stack([np.cos(path.yaw), np.sin(path.yaw)], axis=1)
    assert (ahead * (heading[1:] + heading[:-1]) / 2).sum(1).min() > 0.97  # x points where the vehicle goes
    assert np.abs(np.diff(path.yaw) / path.times[1]).max() < 1.6  # radians per second


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 100_000), st.sampled_from(sorted(ROLES)), st.integers(8, 60))
def test_walks_go_from_crossing_to_crossing_and_pass_no_street_a_third_time(seed, name, blocks):
    walk = np.array(plan_walk(np.random.default_rng(seed), ROLES[name], blocks=blocks))
    steps = np.diff(walk, axis=0)
    assert abs(len(steps) - blocks) <= max(1, blocks // 12)
    assert np.all(np.abs(steps).sum(1) == 1)
    assert not np.any(np.all(steps[1:] == -steps[:-1], axis=1))  # no turning on the spot
    _, times = np.unique(walk[1:] + walk[:-1], axis=0, return_counts=True)  # a street has one middle
    assert times.max() <= 2


def test_too_few_streets_for_a_loop_and_unknown_routes_are_refused():
    with pytest.raises(ValueError, match="no walk of 3 blocks"):
        plan_walk(np.random.default_rng(0), ROLES["08"], blocks=3)
    with pytest.raises(ValueError, match=r"expected a route among 00, 01, .*found '11'"):
        plan_path(np.random.default_rng(0), "11", scans=100)


def test_poses_stand_on_the_hills():
    rng = np.random.default_rng(0)
    relief, xy, yaw = draw_relief(rng), rng.uniform(-300, 300, (50, 2)), rng.uniform(-4, 4, 50)
    poses = poses_on(relief, xy, yaw, height_m=1.7)
    rotation, position = poses[:, :3, :3], poses[:, :3, 3]
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1)
    np.testing.assert_array_equal(position[:, :2], xy)
    np.testing.assert_allclose(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]), np.arctan2(np.sin(yaw), np.cos(yaw)))
    foot = position - 1.7 * rotation[:, :, 2]
    np.testing.assert_allclose(foot[:, 2], relief_height(relief, foot[:, :2]), atol=1e-3)
    for axis in (0, 1):  # forward and left lie along the ground
        nearby = foot + 0.01 * rotation[:, :, axis]
        np.testing.assert_allclose(nearby[:, 2], relief_height(relief, nearby[:, :2]), atol=1e-3)
    assert np.abs(rotation[:, 2, 0]).max() > 1e-3


def pose_file(path, xy, yaw):
    """A KITTI pose file: the camera looks along z, x points right."""
    cos, sin, zero, one = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw)), np.ones(len(yaw))
    rows = [cos, zero, -sin, -xy[:, 1], zero, one, zero, zero + 0.3, sin, zero, cos, xy[:, 0]]
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.stack(rows, axis=1))
    return path


def test_a_pose_file_becomes_a_trajectory(tmp_path):
    path = plan_path(np.random.default_rng(0), "03", scans=300)
    planned = PlanarPath(*(values[scan_rows(path, 60)] for values in path))
    path = read_path(pose_file(tmp_path / "campus.txt", planned.xy, planned.yaw))
    np.testing.assert_allclose(path.xy, planned.xy, atol=1e-9)
    np.testing.assert_allclose(np.cos(path.yaw - planned.yaw), 1)
    np.testing.assert_allclose(path.times, np.arange(60) / 10)
    np.savetxt(tmp_path / "times.txt", planned.times + 5)
    np.testing.assert_allclose(read_path(tmp_path / "campus.txt").times, planned.times)
    np.savetxt(tmp_path / "times.txt", np.arange(60))
    with pytest.warns(DataWarning, match="found row numbers"):
        np.testing.assert_allclose(read_path(tmp_path / "campus.txt").times, np.arange(60) / 10)


def test_a_pose_file_with_z_up_is_told(tmp_path):
    rows = np.tile(np.eye(3, 4), (200, 1, 1))
    rows[:, :2, 3] = np.linspace(0, 300, 200)[:, None]
    np.savetxt(tmp_path / "campus.txt", rows.reshape(200, 12))
    with pytest.warns(DataWarning, match=r"campus.txt: expected z up, found heights over 300 m"):
        read_path(tmp_path / "campus.txt")


@pytest.mark.parametrize(
    ("content", "times", "said"),
    [
        ("", None, "campus.txt: expected 2 poses or more, 12 numbers a line, found 0"),
        (
            "1 0 0 0 0 1 0 0 0 0 1 0\n" * 3,
            "0\n0.5\n",
            "times.txt: expected 3 times, one per pose of campus.txt, found 2",
        ),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "0\n1\n1\n", "times.txt, line 3: expected a time > 1.0, found 1.0"),
    ],
)
def test_a_malformed_pose_file_is_refused(tmp_path, content, times, said):
    (tmp_path / "campus.txt").write_text(content)
    if times:
        (tmp_path / "times.txt").write_text(times)
    with pytest.raises(ValueError, match=said):
        read_path(tmp_path / "campus.txt")


NARROW = Sensor(elevations_deg=(10.0, -10.0, -20.0), azimuth_steps=64, azimuths_deg=(-60.0, 60.0), min_range_m=0.5)
straight = PlanarPath(np.stack([np.arange(0, 800, 0.5), np.zeros(1600)], axis=1), np.zeros(1600), np.arange(1600) / 10)


@pytest.mark.parametrize(
    ("name", "height_m", "bob_m", "tilt_deg"),
    [("backpack", 1.8, 0.03, (3.0, 7.1)), ("handheld", 1.4, 0.04, (9.0, 21.3)), ("cart", 0.6, 0.0, (0.0, 0.0))],
)
def test_a_carrier_has_its_height_and_tilt(name, height_m, bob_m, tilt_deg):
    recording = simulate_repeating("garage", scans=40, seed=2, sensor=NARROW, carrier=CARRIERS[name])
    poses = recording.poses.world_from_lidar
    assert np.abs(poses[:, 2, 3] - height_m).max() <= bob_m + 1e-9
    tilts_deg = np.degrees(np.arccos(poses[:, 2, 2].clip(-1, 1)))  # between the z axis and the vertical
    assert tilt_deg[0] <= tilts_deg.max() <= tilt_deg[1] + 1e-6
    assert recording.mounting is not None and recording.mounting.height_m == height_m


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
