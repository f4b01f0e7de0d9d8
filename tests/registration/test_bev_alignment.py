"""The pose between two images: that of a brute-force search by scipy, and the one that the images were made from."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import difference, place, relative, seen_from
from scipy import ndimage, signal

from sglpr_jax.loops.keyframes import square_image
from sglpr_jax.registration.bev_alignment import align
from sglpr_jax.registration.bev_config import VerificationConfig
from sglpr_jax.se3 import inverse, yaw_of

SMALL = VerificationConfig(reach_m=12.8, max_shift_m=4.0)
YAWS = st.floats(-3.1, 3.1)
SHIFTS = st.floats(-1.5, 1.5)


def pose_of(found) -> np.ndarray:
    return np.array([found.x, found.y, found.yaw])


@pytest.mark.slow
@settings(deadline=None, max_examples=15)
@given(yaw=YAWS, x=SHIFTS, y=SHIFTS, seed=st.integers(0, 5))
def test_the_pose_of_the_images_is_found(yaw, x, y, seed):
    match, query = (0.2, -0.1, 0.4), (x, y, yaw)
    images = [seen_from(place(seed), pose, seed=k) for k, pose in enumerate((query, match))]
    found = align(*images, config=SMALL)
    error = difference(pose_of(found), relative(match, query))
    assert np.hypot(*error[:2]) < 0.15 and abs(np.degrees(error[2])) < 1, error
    assert found.correlation > 0.4 and found.peak_ratio < 0.8 and -np.pi <= found.yaw <= np.pi


def test_the_peak_is_that_of_a_brute_force_search():
    """Every degree and cell, by scipy: rotate, filter, correlate."""
    query, match = seen_from(place(0), (0.7, -0.5, 2.0)), seen_from(place(0), (0.0, 0.0, 0.0))
    axis = (np.arange(64) - 31.5) * 0.4
    inside = np.hypot(axis[:, None], axis[None]) < 12.8

    def filtered(image):
        padded = np.pad(image, 16)
        narrow, wide = (ndimage.gaussian_filter(padded, blur / 0.4, truncate=8) for blur in (0.4, 1.0))
        return (narrow - wide) / np.linalg.norm(narrow - wide)

    best = (-1.0, 0, 0.0, 0.0)
    fixed = filtered(np.sqrt(match) * inside)
    for degrees in range(360):
        turned = ndimage.rotate(np.sqrt(query) * inside, degrees, reshape=False, order=1)
        values = signal.correlate(fixed, filtered(turned), mode="same", method="fft")
        down, right = np.unravel_index(values.argmax(), values.shape)
        best = max(best, (values.max(), degrees, (right - 48) * 0.4, (48 - down) * 0.4))
    found = align(query, match, config=SMALL)
    error = difference(pose_of(found), [best[2], best[3], np.radians(best[1])])
    assert np.abs(error[:2]).max() < 0.3 and abs(np.degrees(error[2])) < 1
    assert found.correlation == pytest.approx(best[0], abs=0.06)


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_between_two_plain_walls_the_place_along_them_is_unknown(yaw):
    rng = np.random.default_rng(0)
    along = rng.uniform(-40, 40, (6000, 1))
    walls = np.concatenate([along, rng.choice([-5.0, 6.0], (6000, 1))], axis=1)
    images = [seen_from(walls, (x, 0.2, yaw), seed=k) for k, x in enumerate((0.0, 1.5))]
    found = align(*images, config=dataclasses.replace(SMALL, max_shift_m=12.0))
    covariance = np.asarray(found.covariance)
    direction = np.array([np.cos(yaw), -np.sin(yaw)])  # of the walls, in the frame of the match
    across = np.array([np.sin(yaw), np.cos(yaw)])
    assert np.sqrt(direction @ covariance[:2, :2] @ direction) >= 2
    assert np.sqrt(across @ covariance[:2, :2] @ across) <= 0.3
    assert found.along_m >= 2


@pytest.mark.slow
def test_errors_in_a_town_are_as_large_as_the_covariance_says(drive):
    poses = drive.poses.world_from_lidar @ inverse(drive.uprights)
    apart = np.linalg.norm(drive.positions[:, None] - drive.positions[None], axis=2)
    apart[np.subtract.outer(drive.times, drive.times) < 30] = np.inf
    queries = np.flatnonzero(apart.min(1) < 8)[::2]
    pairs = [(int(query), int(apart[query].argmin())) for query in queries]
    images = {frame: square_image(drive.scan(frame)) for pair in pairs for frame in pair}
    squares = []
    for query, match in pairs:
        found, true = align(images[query], images[match]), inverse(poses[match]) @ poses[query]
        error = difference(pose_of(found), np.array([*true[:2, 3], float(yaw_of(true))]))
        squares.append(error @ np.linalg.inv(np.asarray(found.covariance, np.float64)) @ error)
    assert len(squares) >= 20
    assert 0.5 < np.median(squares) / 2.37 < 2  # the median of a chi-square of 3 degrees of freedom
    assert np.quantile(squares, 0.95) / 7.81 < 2


def test_other_places_correlate_less_and_another_pose_fits_as_well():
    images = [seen_from(place(seed), (0.0, 0.0, 0.0)) for seed in range(4)]
    same = align(images[0], images[0], config=SMALL)
    assert same.correlation == pytest.approx(1, abs=0.02)
    for other in images[1:]:
        found = align(images[0], other, config=SMALL)
        assert found.correlation < 0.5 < found.peak_ratio


def test_wrong_sizes_are_refused():
    for wrong in (np.zeros((64, 62), np.float32), np.zeros((63, 63), np.float32)):
        with pytest.raises(ValueError, match="square image of an even number"):
            align(wrong, wrong)


def test_empty_images_fit_nothing_and_nothing_is_nan():
    empty = np.zeros((64, 64), np.float32)
    for query, match in ((empty, empty), (empty, seen_from(place(0), (0.0,) * 3))):
        found = align(query, match, config=SMALL)
        assert all(np.isfinite(value).all() for value in found) and abs(found.correlation) < 1e-3
        assert found.peak_ratio == 1
