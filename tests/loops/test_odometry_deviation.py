"""A loop is as many sigmas from the odometry as the drift along the path that explains it."""

import dataclasses

import numpy as np
import pytest
from drives import along, drifted, town, true_loops
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.loops.odometry_deviation import deviations, planar_deviations, step_deviations
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.pose_graph.files import read_g2o, write_g2o
from sglpr_jax.se3 import inverse, inverse_planar, transform

SHARP = dataclasses.replace(DriftModel(), position_m=1e-3, yaw_deg=1e-3)


def exact(poses: np.ndarray, query: int, match: int) -> LoopClosure:
    return LoopClosure(query, match, inverse(poses[match]) @ poses[query], np.zeros((6, 6)), 1.0)


@pytest.mark.slow
@settings(deadline=None, max_examples=30)
@given(percent=st.floats(-1.5, 1.5), degrees=st.floats(-1, 1), start=st.integers(0, 600), length=st.integers(30, 320))
def test_drift_of_constant_rate_is_at_most_its_multiple_of_the_model(percent, degrees, start, length):
    poses = town()
    odometry = drifted(poses, percent=percent, deg_per_100m=degrees)
    (found,) = deviations([exact(poses, start + length, start)], DrivenPath(odometry), drift=SHARP)
    assert found <= 1.1 * np.hypot(percent / 1.0, degrees / 0.5) + 0.05


def test_by_hand_straight_on():
    """After 100 m: 1 % along, a quarter of it across, .5 degrees, and the constants."""
    odometry = along([(0, 0), (101, 0)])
    pose = odometry[100] @ transform(3.0, 0.0, 0.0)
    ahead = LoopClosure(100, 0, pose, np.zeros((6, 6)), 1.0)
    np.testing.assert_allclose(deviations([ahead], DrivenPath(odometry)), 3 / np.hypot(1.0, 0.5), rtol=1e-6)
    unsure = dataclasses.replace(ahead, covariance=np.diag([0.64, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(deviations([unsure], DrivenPath(odometry)), 3 / np.sqrt(1 + 0.25 + 0.64), rtol=1e-6)
    turned = LoopClosure(100, 0, odometry[100] @ transform(0.0, 0.0, np.pi / 2), np.diag([0, 0.64, 0, 0, 0, 0]), 1.0)
    ahead_is_its_right = dataclasses.replace(
        turned, match_from_query=turned.match_from_query @ transform(0.0, -3.0, 0.0)
    )
    both = deviations([turned, ahead_is_its_right], DrivenPath(odometry))
    np.testing.assert_allclose(both[1] ** 2 - both[0] ** 2, 9 / 1.89, rtol=0.01)


def test_a_pose_deviates_as_much_as_its_inverse():
    """The later frame may be the query or the match."""
    path, rng = DrivenPath(drifted(town(), percent=0.5, deg_per_100m=0.2)), np.random.default_rng(0)
    query, match = np.array([300, 700, 500]), np.array([40, 120, 480])
    poses = path.poses[match]
    apart = inverse(poses) @ path.poses[query]
    pose = np.column_stack([apart[:, :2, 3], np.arctan2(apart[:, 1, 0], apart[:, 0, 0])])
    pose += rng.normal(scale=[0.5, 0.5, 0.01], size=(3, 3))
    found = planar_deviations(path, query, match, pose, drift=SHARP)
    np.testing.assert_allclose(
        planar_deviations(path, match, query, inverse_planar(pose), drift=SHARP), found, rtol=0.01
    )
    assert found.max() > 1


def test_a_guessed_path_drifts_in_every_direction():
    odometry = along([(0, 0), (101, 0)])
    guessed_m = np.where(np.arange(101) < 50, 0.0, 100.0)  # one step as uncertain as 100 m
    beside = LoopClosure(100, 0, odometry[100] @ transform(0.0, 3.0, 0.0), np.zeros((6, 6)), 1.0)
    before, after = (deviations([beside], DrivenPath(odometry, guessed_m=one)) for one in (None, guessed_m))
    assert after < 0.6 * before
    (same,) = deviations([exact(odometry, 100, 60)], DrivenPath(odometry, guessed_m=guessed_m))
    assert same == 0


@pytest.mark.parametrize("degrees", [(0.0, 20.0, 0.0), (180.0, 0.0, 0.0)], ids=["nods", "upside down"])
def test_in_a_tilted_world_the_deviations_are_the_same(degrees):
    poses = town()
    odometry, loops = drifted(poses, percent=1, deg_per_100m=0.5), true_loops(poses, every=20)
    world = np.eye(4)
    world[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    found = deviations(loops, DrivenPath(world @ odometry, tilted=True))
    np.testing.assert_allclose(found, deviations(loops, DrivenPath(odometry)), rtol=1e-6)


def test_far_from_the_origin_and_of_nothing():
    poses = town()
    odometry, loops = drifted(poses, percent=1, deg_per_100m=0.5), true_loops(poses, every=20)
    far = odometry.copy()
    far[:, :2, 3] += [4.5e5, 5.4e6]
    np.testing.assert_allclose(deviations(loops, DrivenPath(far)), deviations(loops, DrivenPath(odometry)), rtol=1e-4)
    assert deviations([], DrivenPath(odometry)).shape == (0,)


def test_the_steps_of_a_graph_add_up_to_the_model_after_100_m(tmp_path):
    for step in (0.5, 2.0):
        metres, radians = step_deviations(along([(0, 0), (100 + step, 0)], step), DriftModel())
        assert np.sqrt(np.sum(metres**2)) == pytest.approx(1, rel=0.05)
        assert np.degrees(np.sqrt(np.sum(radians**2))) == pytest.approx(0.5, rel=0.1)
    metres, radians = step_deviations(np.tile(np.eye(4), (3, 1, 1)), DriftModel())
    assert (metres > 0).all() and (radians > 0).all()
    poses = along([(0, 0), (3, 0)])
    write_g2o(tmp_path / "a.g2o", [], [(np.arange(len(poses)), poses, DriftModel(0.1, 0.05))])
    information = read_g2o(tmp_path / "a.g2o").edges[0][3]
    assert information[0, 0] == pytest.approx(1 / (1.0 + 2.5e-5), rel=1e-6)


def test_odometry_drifts_as_much_at_any_scale():
    """Only the constants of the comparison belong to the images."""
    poses, pairs = town(), ((300, 40), (700, 120))
    odometry, drift = drifted(poses, percent=1, deg_per_100m=0.5), dataclasses.replace(SHARP, height_m=1e-3)
    large, large_odometry = scaled_poses(poses, 4.0), scaled_poses(odometry, 4.0)
    expected = deviations([exact(poses, *pair) for pair in pairs], DrivenPath(odometry), drift=drift)
    loops = [exact(large, *pair) for pair in pairs]
    found = deviations(loops, DrivenPath(large_odometry), drift=drift.at_scale(4.0))
    np.testing.assert_allclose(found, expected, rtol=0.02)


@pytest.mark.parametrize(("name", "value"), [("metres_per_metre", -0.1), ("position_m", 0.0), ("position_m", np.nan)])
def test_an_impossible_drift_is_an_error(name, value):
    with pytest.raises(ValueError, match=f"DriftModel.{name}: expected a (finite )?number"):
        DriftModel(**{name: value})
    assert str(DriftModel(0.1, 0.05)) == "10 % and 5 degrees per 100 m"


def ramp(laps: int, rise_m: float) -> np.ndarray:
    """Poses every metre along a ring of 100 m that rises by `rise_m` in each lap."""
    angle = 2 * np.pi * np.arange(100 * laps) / 100
    poses = np.stack([transform(*(100 / (2 * np.pi) * np.array([np.sin(a), -np.cos(a)])), a) for a in angle])
    poses[:, 2, 3] = rise_m * angle / (2 * np.pi)
    return poses


def test_floors_that_look_alike_are_apart_in_height():
    """Four laps of a ramp: each loop between two of them fits in the plane, and none fits in height."""
    flat, rising = ramp(4, 0.0), ramp(4, 3.5)
    loops = [exact(flat, query, match) for query in (150, 250, 399) for match in range(query % 100, query - 99, 100)]
    assert deviations(loops, DrivenPath(flat)).max() < 1e-6
    assert deviations(loops, DrivenPath(rising)).min() > DriftModel().max_deviation
    unsure = dataclasses.replace(DriftModel(), height_per_metre=0.01)
    assert deviations(loops, DrivenPath(rising), drift=unsure).max() < DriftModel().max_deviation


def test_height_by_hand():
    odometry = along([(0, 0), (101, 0)])
    above = LoopClosure(100, 0, odometry[100] @ transform(0.0, 0.0, 0.0), np.diag([0, 0, 0.16, 0, 0, 0]), 1.0)
    above.match_from_query[2, 3] = 2.0
    np.testing.assert_allclose(
        deviations([above], DrivenPath(odometry)), 2 / np.sqrt(0.3**2 + 0.3**2 + 0.16), rtol=1e-6
    )


@settings(deadline=None, max_examples=10)
@given(roll=st.floats(-0.3, 0.3), pitch=st.floats(-0.3, 0.3))
def test_another_floor_is_seen_in_a_world_that_is_tilted(roll, pitch):
    world = np.eye(4)
    world[:3, :3] = Rotation.from_euler("xy", [roll, pitch]).as_matrix()
    for rise_m, other in ((0.0, False), (3.5, True)):
        path = DrivenPath(world @ ramp(3, rise_m), tilted=True)
        query, match = np.array([299, 299, 99]), np.array([199, 99, 199])
        found = planar_deviations(path, query, match, np.zeros((3, 3)), drift=DriftModel())
        assert ((found > DriftModel().max_deviation) == other).all()
