from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.bev import rotate_image
from sglpr_jax.evaluation.protocols.top1 import TOP1_F1MAX
from sglpr_jax.methods.handcrafted.polar_fft import polar_fft
from sglpr_jax.methods.handcrafted.thumbnail import thumbnail

from .kitti_bev import KITTI_BEV_RADIUS, read_kitti_bev


def rotate(images, angles):
    return np.concatenate(
        [
            np.asarray(rotate_image(jnp.asarray(images[i : i + 100]), jnp.asarray(angles[i : i + 100])))
            for i in range(0, len(images), 100)
        ]
    )


@pytest.fixture
def streets() -> np.ndarray:
    """Return images (4, 65, 65) of blurred walls and trees, empty outside the largest circle."""
    rng = np.random.default_rng(0)
    down, right = np.mgrid[-32:33, -32:33]
    images = np.zeros((4, 65, 65))
    for image in images:
        for row, column in rng.uniform(-20, 20, (12, 2)):
            image += 10 * np.exp(-((down - row) ** 2 + (right - column) ** 2) / 8)
    return (images * (np.hypot(down, right) < 31)).astype(np.float32)


def polar_fft_in_loops(image, centre, radius):
    sums = np.zeros((20, 60))
    for row, column in np.ndindex(*image.shape):
        down, right = row - centre[0], column - centre[1]
        distance = np.sqrt(down**2 + right**2)
        if distance < radius:
            turn = np.arctan2(down, right) / (2 * np.pi) % 1.0
            sums[int(distance / radius * 20), int(turn * 60) % 60] += 25.5 * image[row, column]
    rings = np.log(1 + sums)
    waves = np.exp(-2j * np.pi * np.outer(np.arange(60), np.arange(16)) / 60)
    spectrum = np.abs(rings @ waves).ravel()
    return spectrum / np.linalg.norm(spectrum)


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=10)
def test_polar_fft_is_the_sum_it_says(seed):
    image = np.random.default_rng(seed).integers(0, 5, (20, 31)).astype(np.int32)
    np.testing.assert_allclose(polar_fft(image[None])[0], polar_fft_in_loops(image, (9.5, 15.0), 10), atol=1e-6)
    np.testing.assert_allclose(
        polar_fft(image[None], centre=(8.0, 12.0), radius=7.5)[0], polar_fft_in_loops(image, (8, 12), 7.5), atol=1e-6
    )


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_polar_fft_is_unmoved_by_quarter_turns(turns):
    # An image of even size has no middle pixel, which would stay in its sector.
    images = np.random.default_rng(0).integers(0, 5, (3, 40, 40))
    np.testing.assert_allclose(polar_fft(np.rot90(images, turns, axes=(1, 2))), polar_fft(images), atol=1e-6)


@pytest.mark.parametrize("angle", [0.3, 1.0, 2.5, -1.7])
def test_a_rotation_hardly_moves_polar_fft_and_moves_the_thumbnail(streets, angle):
    turned = rotate(streets, np.full(4, angle, np.float32))
    apart = {
        method: np.linalg.norm(method(turned) - method(streets), axis=1).mean()
        / np.linalg.norm(method(streets)[[1, 2, 3, 0]] - method(streets), axis=1).mean()
        for method in (polar_fft, thumbnail)
    }
    assert apart[polar_fft] < 0.25
    assert apart[thumbnail] > 0.75


def test_a_thumbnail_is_the_mean_of_blocks():
    image = np.random.default_rng(0).random((1, 50, 100), np.float32)
    blocks = image.reshape(25, 2, 25, 4).mean(axis=(1, 3)).ravel()
    np.testing.assert_allclose(thumbnail(image)[0], blocks / np.linalg.norm(blocks), rtol=1e-5)


def test_a_thumbnail_shares_a_pixel_between_two_blocks():
    image = np.zeros((1, 30, 30), np.float32)
    image[0, 1, 0] = 1.0  # row 1 lies to a fifth in block 0 (rows 0 to 1.2) and to four fifths in block 1
    np.testing.assert_allclose(thumbnail(image)[0, [0, 25]], np.array([1, 4]) / np.sqrt(17), rtol=1e-5)


@pytest.mark.parametrize("method", [polar_fft, thumbnail])
def test_descriptors_have_unit_length_and_an_empty_image_gives_zeros(streets, method):
    images = np.concatenate([streets, np.zeros((1, 65, 65), np.float32)])
    descriptors = method(images)
    assert descriptors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), [1, 1, 1, 1, 0], atol=1e-6)


@pytest.mark.slow
def test_rotated_real_scans_leave_polar_fft_and_break_the_thumbnail(shared):
    images, file = read_kitti_bev(shared, "06")
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, len(images)).astype(np.float32)
    turned = rotate(images, angles)
    score = {
        method: [TOP1_F1MAX(replace(file, descriptors=method(x))).score for x in (images, turned)]
        for method in (lambda x: polar_fft(x, radius=KITTI_BEV_RADIUS), thumbnail)
    }
    (polar, polar_turned), (thumb, thumb_turned) = score.values()
    assert abs(polar_turned - polar) < 0.03
    assert thumb > 0.85
    assert thumb_turned < 0.45
