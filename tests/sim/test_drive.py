"""The eleven routes: which revisits they have, and that a car could drive them; pose files; poses on hills."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.se3 import distances
from sglpr_jax.sim.drive import (
    name_of_path,
    plan_path,
    plan_scan_path,
    poses_on,
    read_path,
    speeds,
    thinned,
)
from sglpr_jax.sim.ground import Relief, draw_relief, relief_height
from sglpr_jax.sim.routes import ROLES, plan_walk

SAME, OPPOSITE = ("00", "02", "05", "06", "07", "09"), ("08",)
LEAST = {"00": 0.12, "02": 0.08, "05": 0.12, "06": 0.1, "07": 0.05, "08": 0.1, "09": 0.03}
CASES = [(name, scans, seed) for name in ROLES for scans, seed in ((200, 0), (200, 5), (400, 1), (1500, 2))]


def revisits(trajectory) -> tuple[float, float, np.ndarray]:
    """Shares of the scans within 3 m of one 30 s older that heads the same and the opposite way; and when."""
    apart = distances(trajectory.xy, trajectory.xy)
    apart[trajectory.times[:, None] - trajectory.times[None, :] < 30] = np.inf
    heading = np.cos(trajectory.yaw - trajectory.yaw[apart.argmin(1)])
    again = apart.min(1) <= 3
    return np.mean(again & (heading > 0.7)), np.mean(again & (heading < -0.7)), trajectory.times[again]


@pytest.mark.parametrize(("name", "scans", "seed"), CASES)
def test_a_route_has_the_revisits_of_its_namesake(name, scans, seed):
    trajectory = plan_scan_path(np.random.default_rng(seed), name, scans=scans)
    same, opposite, when = revisits(trajectory)
    if name in SAME:
        assert LEAST[name] <= same <= 0.3 and opposite < 0.02
    elif name in OPPOSITE:
        assert LEAST[name] <= opposite <= 0.3 and same < 0.02
    else:
        assert same == opposite == 0
    if name in ("06", "07", "09"):
        assert when.min() > 0.6 * trajectory.times[-1]  # they come back at the end


@pytest.mark.parametrize(("name", "scans", "seed"), CASES)
def test_a_car_could_drive_it(name, scans, seed):
    path = plan_path(np.random.default_rng(seed), name, scans=scans)
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


@pytest.mark.parametrize("name", ROLES)
def test_the_scans_are_spread_over_the_whole_path(name):
    path = plan_path(np.random.default_rng(3), name, scans=250)
    trajectory = plan_scan_path(np.random.default_rng(3), name, scans=250)
    every = len(path.times) // 250
    assert len(trajectory.times) == 250
    for values, kept in zip(path, trajectory, strict=True):
        np.testing.assert_array_equal(values[::every], kept)
    assert 0.15 < trajectory.times[1] < 0.4  # around 4 Hz
    at_kittis_rate = plan_scan_path(np.random.default_rng(3), name, scans=1000, rate_hz=10.0)
    assert 0.07 < at_kittis_rate.times[1] < 0.13


def test_few_scans_are_spread_over_a_drive_that_comes_back():
    trajectory = plan_scan_path(np.random.default_rng(0), "08", scans=3)
    assert len(trajectory.times) == 3 and trajectory.times[-1] > 30


def test_lanes_differ_between_visits_and_keep_to_the_right():
    path = plan_path(np.random.default_rng(0), "08", scans=600)
    apart = distances(path.xy, path.xy)
    apart[path.times[:, None] - path.times[None, :] < 30] = np.inf
    earlier = apart.argmin(1)
    opposite = (apart.min(1) < 4) & (np.cos(path.yaw - path.yaw[earlier]) < -0.97)
    offset = path.xy[earlier] - path.xy
    left = (-np.sin(path.yaw) * offset[:, 0] + np.cos(path.yaw) * offset[:, 1])[opposite]
    assert opposite.sum() > 100 and left.min() > 1 and np.ptp(left) > 0.3


def test_the_seed_decides_the_route():
    one, again, other = (plan_path(np.random.default_rng(seed), "05", scans=300).xy for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert one.shape != other.shape or np.abs(one - other).max() > 10


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
        plan_scan_path(np.random.default_rng(0), "11", scans=100)


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


PLAIN = Relief(np.zeros(1), np.ones((1, 2)), np.zeros(1))


def test_poses_on_a_plain_are_level():
    (pose,) = poses_on(PLAIN, np.array([[3.0, 4.0]]), np.array([np.pi / 2]), height_m=2.0)
    np.testing.assert_allclose(pose, [[0, -1, 0, 3], [1, 0, 0, 4], [0, 0, 1, 2], [0, 0, 0, 1]], atol=1e-15)


def pose_file(path, xy, yaw):
    """A KITTI pose file: the camera looks along z, x points right."""
    cos, sin, zero, one = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw)), np.ones(len(yaw))
    rows = [cos, zero, -sin, -xy[:, 1], zero, one, zero, zero + 0.3, sin, zero, cos, xy[:, 0]]
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.stack(rows, axis=1))
    return path


def test_a_pose_file_becomes_a_trajectory(tmp_path):
    planned = thinned(plan_path(np.random.default_rng(0), "03", scans=300), 60)
    path = read_path(pose_file(tmp_path / "campus.txt", planned.xy, planned.yaw))
    np.testing.assert_allclose(path.xy, planned.xy, atol=1e-9)
    np.testing.assert_allclose(np.cos(path.yaw - planned.yaw), 1)
    np.testing.assert_allclose(path.times, np.arange(60) / 10)
    np.savetxt(tmp_path / "times.txt", planned.times + 5)
    np.testing.assert_allclose(read_path(tmp_path / "campus.txt").times, planned.times)


def test_drives_are_named_by_their_pose_file(tmp_path):
    assert name_of_path(tmp_path / "poses" / "06.txt") == "06"
    assert name_of_path(tmp_path / "sequences" / "08" / "poses.txt") == "08"


def test_kittis_own_poses_head_where_the_car_goes(shared):
    path = read_path(shared / "data" / "kitti_odometry" / "poses" / "06.txt")
    assert len(path.times) == 1101
    step = np.diff(path.xy, axis=0)
    fast = np.linalg.norm(step, axis=1) > 0.5
    heading = np.arctan2(step[:, 1], step[:, 0])
    assert np.cos(heading - path.yaw[:-1])[fast].min() > 0.97
    same, opposite, _ = revisits(path)
    assert same > 0.2 and opposite == 0


@pytest.mark.parametrize(
    ("content", "times", "said"),
    [
        ("", None, "campus.txt: expected 2 poses or more, 12 numbers a line, found 0"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2 + "1 0 0 0 0 1 0 nan 0 0 1 0\n", None, "campus.txt, line 3: .*finite.*nan"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 2 3\n", None, "campus.txt, line 2: expected 12 numbers, found 3"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "0\n1\n", "times.txt: expected 3 times, one per pose of campus.txt, found 2"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "0\n1\n1\n", "times.txt, line 3: expected a time > 1.0, found 1.0"),
    ],
)
def test_a_malformed_pose_file_is_refused(tmp_path, content, times, said):
    (tmp_path / "campus.txt").write_text(content)
    if times:
        (tmp_path / "times.txt").write_text(times)
    with pytest.raises(ValueError, match=said):
        read_path(tmp_path / "campus.txt")


def test_a_missing_pose_file_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"06.txt: expected a file with 12 numbers a line"):
        read_path(tmp_path / "06.txt")
