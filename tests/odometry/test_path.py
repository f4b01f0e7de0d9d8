"""The integrals of a path equal sums over its steps, whether its poses are added one by one or at once."""

import numpy as np
import pytest
from drives import along, town
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sglpr_jax.data.mounting import Mounting, upright_from_lidar
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.se3 import inverse, travelled


def test_one_by_one_is_at_once():
    poses = town()
    whole, found = DrivenPath(poses), DrivenPath()
    for pose in poses:
        found.extend(pose[None])
    np.testing.assert_array_equal(found.poses, poses)
    np.testing.assert_allclose(found.travelled, travelled(poses), rtol=1e-12)
    rows = np.arange(len(poses))
    for one, other in zip(found.between(rows * 0, rows), whole.between(rows * 0, rows), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-6)


@settings(deadline=None, max_examples=30)
@given(
    positions=arrays(np.float64, (12, 3), elements=st.floats(-50, 50)),
    guesses=arrays(np.float64, (12,), elements=st.floats(0, 5)),
    ends=st.tuples(st.integers(0, 11), st.integers(0, 11)),
)
def test_the_integrals_are_sums_over_small_steps(positions, guesses, ends):
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, :3, 3] = positions
    guessed_m = guesses.cumsum()
    start, end = ends
    found = DrivenPath(poses, guessed_m=guessed_m).between(np.array([start]), np.array([end]))
    sign, (first, last) = (1, (start, end)) if start <= end else (-1, (end, start))
    length, place, squares = 0.0, np.zeros(3), np.zeros((3, 3))
    for k in range(first, last):
        step = np.linalg.norm(positions[k + 1] - positions[k]) + guessed_m[k + 1] - guessed_m[k]
        for share in (np.arange(200) + 0.5) / 200:
            at = positions[k] + share * (positions[k + 1] - positions[k]) - positions[0]
            length, place, squares = (
                length + step / 200,
                place + step / 200 * at,
                squares + step / 200 * np.outer(at, at),
            )
    np.testing.assert_allclose(found.length, sign * length, atol=1e-6)
    np.testing.assert_allclose(found.position[0], sign * place, atol=1e-4 * max(1, np.abs(place).max()))
    np.testing.assert_allclose(found.position_products[0], sign * squares, atol=1e-4 * max(1, np.abs(squares).max()))


def test_positions_drift_along_and_by_the_turns_before():
    poses = along([(0, 0), (101, 0)])
    rows = np.arange(len(poses))
    found = DrivenPath(poses).position_deviations(rows, 100)
    assert found[100] == 0 and (np.diff(found) < 0).all()
    lever = np.radians(0.5) * 100 / np.sqrt(3)
    assert found[0] == pytest.approx(np.sqrt(1 + 0.25**2 + lever**2), rel=1e-3)
    np.testing.assert_allclose(DrivenPath(poses[::-1]).position_deviations(rows, 0), found[::-1], atol=1e-6)


def test_a_level_world_has_up_of_the_sensor_on_average_and_only_a_tilted_sensor_turns_it():
    tilted = upright_from_lidar(Mounting(1.73, (0.5, 0.0, np.sqrt(0.75))))
    level, nods = (DrivenPath(inverse(tilted) @ town(), tilted=flag) for flag in (False, True))
    np.testing.assert_allclose(
        nods.leveled(np.arange(len(nods)))[:, :3, 2], np.tile([0, 0, 1.0], (len(nods), 1)), atol=1e-12
    )
    assert (level.level == np.eye(3)).all() and (DrivenPath(tilted=True).level == np.eye(3)).all()
