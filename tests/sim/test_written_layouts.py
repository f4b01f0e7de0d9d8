"""Varied scans: what is left of each, with its labels, levelled and turned."""

import numpy as np
import pytest

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.sim.layouts import vary

SCANS = 300


@pytest.fixture(scope="module")
def varied():
    """Clouds of 64 rings of 40 points, each at ranges of its own, and what is left; a point's label is its number."""
    rng = np.random.default_rng(0)
    elevation, azimuth = np.meshgrid(np.deg2rad(np.linspace(-24, 2, 64)), np.linspace(0, 2 * np.pi, 40, endpoint=False))
    across = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1).reshape(-1, 3)
    scans = [(rng.uniform(5, 50, (len(across), 1)) * across).astype(np.float32) for _ in range(SCANS)]
    return [(points, *vary(points, np.arange(len(points)), None)) for points in scans]


def test_what_is_left_of_a_scan_is_rotated_about_z_as_a_whole(varied):
    angles = []
    for points, turned, labels in varied:
        left = points[labels]
        assert turned.dtype == np.float32 and len(turned) == len(labels) > 0
        np.testing.assert_array_equal(turned[:, 2], left[:, 2])
        turn = (turned[:, 0] + 1j * turned[:, 1]) / (left[:, 0] + 1j * left[:, 1])
        np.testing.assert_allclose(turn, turn[0], atol=1e-5)
        np.testing.assert_allclose(np.abs(turn), 1, rtol=1e-5)
        angles.append(np.angle(turn[0]) % (2 * np.pi))
    np.testing.assert_allclose(np.quantile(angles, [0.25, 0.5, 0.75]) / np.pi, [0.5, 1, 1.5], atol=0.2)


def test_some_scans_stay_whole_some_lose_rings_and_some_lose_points_of_all_rings(varied):
    rings = np.array([len(np.unique(labels % 64)) for _, _, labels in varied])
    left = np.array([len(labels) / len(points) for points, _, labels in varied])
    whole, fewer = left == 1, np.isin(rings, (32, 16)) & (left == rings / 64)
    assert 0.22 < whole.mean() < 0.38 and 0.22 < fewer.mean() < 0.38 and len(set(rings[fewer])) == 2
    thinned = left[~whole & ~fewer]
    assert 0.04 < thinned.min() < 0.12 and 0.88 < thinned.max() < 1
    np.testing.assert_allclose(np.median(thinned), 0.525, atol=0.12)


def test_the_scan_alone_decides_and_it_is_levelled_before_it_is_turned(varied):
    points, turned, labels = varied[7]
    again, same = vary(points.copy(), np.arange(len(points)), None)
    np.testing.assert_array_equal(again, turned)
    np.testing.assert_array_equal(same, labels)
    lifted, _ = vary(points, np.arange(len(points)), Mounting(height_m=0.73))
    np.testing.assert_allclose(lifted[:, 2], turned[:, 2] - 1.0, atol=1e-5)
