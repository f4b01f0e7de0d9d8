"""LiDAR Iris: the filters, the alignment and the distance are those of its authors."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.methods.handcrafted.lidar_iris import (
    Spectra,
    column_shifts,
    lidar_iris,
    lidar_iris_distance,
    rotation_and_scale,
    spectra,
)
from tests.methods import published_iris as published


@pytest.fixture(scope="module")
def images(places, turn_points):
    """Images of three places, of the first one turned and moved, and of nothing."""
    scans = [points for points, _ in places[:3]]
    scans += [
        turn_points(scans[0] + np.float32([dx, 0.5, 0]), turn) for dx, turn in ((0.4, 0.031), (1.5, 2.0), (0, 3.1))
    ]
    return np.stack([*map(lidar_iris, scans), np.zeros(28800, np.float32)]).reshape(-1, 80, 360)


@pytest.mark.slow
def test_the_alignment_is_the_published_one(images):
    images = images[:-1].astype(np.float64)
    found = column_shifts(*[spectra(jnp.asarray(images, jnp.float32) / 255)] * 2)
    expected = [
        [(published.shift_of(a, b), published.shift_of(a, np.roll(b, 180, axis=1)) - 180) for b in images]
        for a in images
    ]
    different = ~np.eye(len(images), dtype=bool)  # of an image with itself the peak is at 0, but for rounding
    np.testing.assert_array_equal((found - np.array(expected))[different] % 360, 0)
    between = (found[..., 0] - found[..., 1])[different] % 360
    assert set(np.unique(between)) == {1, 359}, "rounded from the other side"


@pytest.fixture(scope="module")
def smooth():
    """A blurred image that ends in nothing."""
    frequency = np.hypot(*np.meshgrid(*map(np.fft.fftfreq, (360, 80))))
    blurred = np.fft.ifft2(np.fft.fft2(np.random.default_rng(0).random((80, 360))) / (1 + 40 * frequency)).real
    return (blurred - blurred.mean()) * np.outer(np.hanning(80), np.hanning(360))


@pytest.mark.parametrize(("degrees", "scale"), [(9.0, 1.0), (4.0, 0.95)])
def test_turn_and_scale_are_taken_out_first(smooth, degrees, scale):
    other = np.roll(published.turned_and_scaled(smooth, math.radians(degrees), scale), 25, axis=1)
    found = column_shifts(*(spectra(jnp.asarray(x, jnp.float32)[None]) for x in (smooth, other)))
    assert int(found[0, 0, 0]) == published.shift_of(255 * smooth, 255 * other)
    assert abs(int(found[0, 0, 0]) - 25) <= 3


@pytest.mark.slow
@pytest.mark.parametrize(("down", "right"), [(5, 20), (5, 60)])
def test_a_scale_beyond_1_8_is_taken_for_its_inverse(down, right):
    polar = np.random.default_rng(0).random((80, 360))
    there, here = (jnp.fft.rfft2(jnp.asarray(x)) for x in (polar, np.roll(polar, (-down, -right), axis=(0, 1))))
    image = jnp.zeros((80, 360))
    angle, scale = rotation_and_scale(Spectra(image, there, here), Spectra(image, there, there))
    side = -1 if right == 60 else 1
    assert float(angle) == pytest.approx(side * math.pi * down / 80, abs=1e-3)
    assert float(scale) == pytest.approx(math.hypot(40, 180) ** (side * right / 360), rel=1e-2)


@pytest.mark.slow
def test_the_distance_is_the_hamming_distance_of_the_signs(images):
    rows = images.reshape(len(images), -1)
    expected = [[published.distance(a.astype(float), b.astype(float)) for b in images] for a in images[:3]]
    found = lidar_iris_distance(rows[:3], rows)
    np.testing.assert_allclose(found, expected, atol=1e-4)  # of 230,400 bits, those of a response of 0 are rounding
    assert expected[0][-1] == 1
