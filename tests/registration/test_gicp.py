"""Poses between full scans: those that the scans were simulated from; and what tells a loop from none."""

import numpy as np
import pytest
from drives import error_of
from scipy.spatial.transform import Rotation

from sglpr_jax.loops.closure import DEGENERATE_M
from sglpr_jax.registration.gicp import overlap, register
from sglpr_jax.se3 import inverse, transform, transformed

GUESS = np.diag([0.5, 0.5, 0.1, 0.02, 0.02, 0.04]) ** 2
"""Covariance of a first guess."""


@pytest.fixture(scope="module")
def pair(drive, revisit):
    """The scans of a revisit, query and match, and the true match_from_query."""
    query, match = revisit
    poses = drive.poses.world_from_lidar
    return drive.points(query), drive.points(match), inverse(poses[match]) @ poses[query]


def test_a_first_guess_is_refined_and_errors_are_as_large_as_the_covariance_says(pair):
    query, match, expected = pair
    found = register(query, match, initial=expected @ transform(0.3, -0.2, np.radians(2)), initial_covariance=GUESS)
    metres, degrees = error_of(found.match_from_query, expected)
    assert metres < 0.1 and degrees < 0.3
    assert found.overlap > 0.5 and overlap(query, match, found.match_from_query) == found.overlap
    assert (np.linalg.eigvalsh(found.covariance) > 0).all() and found.covariance.shape == (6, 6)
    apart = inverse(expected) @ found.match_from_query
    error = np.concatenate([apart[:3, 3], Rotation.from_matrix(apart[:3, :3]).as_rotvec()])
    assert 0.3 < error @ np.linalg.inv(found.covariance) @ error < 16.8  # 99 % of a chi-square of 6 degrees of freedom
    assert np.linalg.eigvalsh(found.covariance[:2, :2]).max() < 0.05**2
    # Points metres away fix the rotation to far less than their own errors.
    deviations = np.sqrt(np.diag(found.covariance))
    assert deviations[3:].max() < deviations[:3].min()


def test_between_plain_walls_the_first_guess_stays_unknown_along_them():
    rng = np.random.default_rng(0)
    along = rng.uniform(-40, 40, 20000)
    sides = np.stack([along, rng.choice([-4.0, 5.0], 20000), rng.uniform(-1, 3, 20000)], axis=1)
    floor = np.stack([along, rng.uniform(-4, 5, 20000), np.full(20000, -1.7)], axis=1)
    walls = np.concatenate([sides, floor])
    query, match = ((walls + 0.01 * rng.normal(size=walls.shape)).astype(np.float32) for _ in range(2))
    guess = np.diag([4.0, 0.1, 0.1, 0.02, 0.02, 0.02]) ** 2
    found = register(query, match, initial=np.eye(4), initial_covariance=guess)
    deviations = np.sqrt(np.diag(found.covariance))
    assert deviations[0] == pytest.approx(4.0, rel=0.2) and deviations[1] < 0.1 and deviations[2] < 0.1
    assert np.linalg.eigvalsh(found.covariance[:2, :2]).max() > DEGENERATE_M**2


@pytest.mark.slow
def test_other_places_do_not_overlap(drive, revisit):
    query, guess = drive.points(revisit[0]), {"initial": np.eye(4), "initial_covariance": GUESS}
    far = np.argsort(-np.linalg.norm(drive.positions - drive.positions[revisit[0]], axis=1))[:2]
    assert all(register(query, drive.points(int(other)), **guess).overlap < 0.5 for other in far)


def test_the_overlap_of_a_scan_with_itself_is_whole_and_counts_voxels():
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-20, 20, (3000, 3)).astype(np.float32)
    moved = transform(0.0, 0.0, 1.0)
    assert overlap(transformed(inverse(moved), cloud), cloud, moved) == 1
    grid = np.stack(np.meshgrid(*[np.arange(-5, 5) + 0.5] * 3), -1).reshape(-1, 3)
    assert overlap(grid, grid, transform(2.0, 0.0, 0.0)) == pytest.approx(0.8)
    assert overlap(grid, grid + np.array([200, 0, 0]), np.eye(4)) == 0
    half = grid[grid[:, 0] > 0]
    assert overlap(half, grid, np.eye(4)) == overlap(grid, half, np.eye(4)) == 1


def test_scans_of_next_to_no_points_are_refused():
    cloud = np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32)
    broken = np.full_like(cloud, np.nan)
    with pytest.raises(ValueError, match="expected a match of 100 finite points or more to register, found 0"):
        register(cloud, broken, initial=np.eye(4), initial_covariance=GUESS)
