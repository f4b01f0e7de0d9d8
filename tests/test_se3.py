"""Transforms against products of matrices."""

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sglpr_jax.se3 import (
    adjoint,
    are_rotations,
    from_quaternions,
    inverse,
    quaternions,
    transform,
    transformed,
    travelled,
    yaw_of,
)

coordinates = st.floats(-1e4, 1e4)


def poses(n: int = 5) -> np.ndarray:
    found = np.tile(np.eye(4), (n, 1, 1))
    found[:, :3, :3] = Rotation.random(n, rng=np.random.default_rng(0)).as_matrix()
    found[:, :3, 3] = np.random.default_rng(1).normal(size=(n, 3))
    return found


def test_the_inverse_is_that_of_the_matrix():
    np.testing.assert_allclose(inverse(poses()), np.linalg.inv(poses()), atol=1e-12)
    np.testing.assert_allclose(inverse(poses()[0]), np.linalg.inv(poses()[0]), atol=1e-12)


def test_a_motion_in_the_plane_moves_points_as_it_says():
    moved = transformed(transform(1.0, 2.0, np.pi / 2), np.array([[3.0, 0, 5]]))
    np.testing.assert_allclose(moved, [[1, 5, 5]], atol=1e-12)
    assert yaw_of(transform(0.0, 0.0, 2.5)) == pytest.approx(2.5)


def test_quaternions_go_there_and_back():
    found = quaternions(poses())
    assert (found[:, 3] >= 0).all()
    np.testing.assert_allclose(from_quaternions(poses()[:, :3, 3], found), poses(), atol=1e-12)


def test_the_adjoint_moves_small_motions_to_another_frame():
    motion = 1e-6 * np.random.default_rng(2).normal(size=6)
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = Rotation.from_rotvec(motion[3:]).as_matrix(), motion[:3]
    in_other_frame = poses() @ moved @ np.linalg.inv(poses())
    expected = np.concatenate(
        [in_other_frame[:, :3, 3], Rotation.from_matrix(in_other_frame[:, :3, :3]).as_rotvec()], axis=1
    )
    np.testing.assert_allclose(adjoint(poses()) @ motion, expected, atol=1e-10)


def test_travelled_distance_is_the_sum_of_steps():
    line = np.tile(np.eye(4), (3, 1, 1))
    line[:, 0, 3] = [0, 3, 3]
    line[:, 1, 3] = [0, 4, 5]
    np.testing.assert_allclose(travelled(line), [0, 5, 6])


@hypothesis.settings(deadline=None, max_examples=25)
@hypothesis.given(st.floats(-4, 4), st.sampled_from([0.0, 0.02, 1e300, np.inf, np.nan]))
def test_rotations_are_distinguished_from_other_matrices(angle, error):
    turned = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    mirror, damaged = turned * [1, 1, -1], turned + np.full((3, 3), error)
    np.testing.assert_array_equal(are_rotations(np.stack([turned, mirror, damaged])), [True, False, error == 0])
    assert are_rotations(turned)
