"""Transforms against products of matrices."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sglpr_jax.se3 import (
    from_quaternions,
    inverse,
    quaternions,
    transform,
    transformed,
    travelled,
    yaw_of,
)


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


def test_the_way_is_the_sum_of_steps():
    line = np.tile(np.eye(4), (3, 1, 1))
    line[:, 0, 3] = [0, 3, 3]
    line[:, 1, 3] = [0, 4, 5]
    np.testing.assert_allclose(travelled(line), [0, 5, 6])
