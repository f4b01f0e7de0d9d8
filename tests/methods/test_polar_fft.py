"""Polar-FFT against its definition, and under rotations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.bev import rotate_image
from sglpr_jax.methods.handcrafted.polar_fft import polar_fft


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


@pytest.mark.parametrize("angle", [0.3, 2.5])
def test_a_rotation_hardly_moves_polar_fft(streets, angle):
    here, turned = polar_fft(streets), polar_fft(np.asarray(rotate_image(streets, np.full(4, angle, np.float32))))
    moved, between = (np.linalg.norm(other - here, axis=1).mean() for other in (turned, here[[1, 2, 3, 0]]))
    assert moved < 0.25 * between


def test_descriptors_have_unit_length_and_an_empty_image_gives_zeros(streets):
    descriptors = polar_fft(np.concatenate([streets, np.zeros((1, 65, 65), np.float32)]))
    assert descriptors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), [1, 1, 1, 1, 0], atol=1e-6)
