"""Varied scans: what is left of each, with its labels, levelled and turned; and the images that are made of them."""

import numpy as np
import pytest

from sglpr_jax.data.density_image import density_image, density_label_image
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.readers import open_recording
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.simulation import _lidar, simulate
from sglpr_jax.sim.variety import vary

SCANS = 300


def scans(count):
    """Clouds of 64 rings of 40 points, each at ranges of its own; the label of a point is its number."""
    rng = np.random.default_rng(0)
    elevation, azimuth = np.meshgrid(np.deg2rad(np.linspace(-24, 2, 64)), np.linspace(0, 2 * np.pi, 40, endpoint=False))
    across = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1).reshape(-1, 3)
    for _ in range(count):
        yield (rng.uniform(5, 50, (len(across), 1)) * across).astype(np.float32), np.arange(len(across))


def angle_about_z(points, turned):
    return np.angle((turned[:, 0] + 1j * turned[:, 1]) / (points[:, 0] + 1j * points[:, 1]))


@pytest.fixture(scope="module")
def varied():
    return [(points, *vary(points, labels, None)) for points, labels in scans(SCANS)]


def test_what_is_left_of_a_scan_is_rotated_about_z_as_a_whole(varied):
    angles = []
    for points, turned, labels in varied:
        left = points[labels]
        assert turned.dtype == np.float32 and len(turned) == len(labels) > 0
        np.testing.assert_array_equal(turned[:, 2], left[:, 2])
        np.testing.assert_allclose(np.hypot(*turned[:, :2].T), np.hypot(*left[:, :2].T), rtol=1e-5)
        angle = angle_about_z(left.astype(float), turned)
        np.testing.assert_allclose(np.exp(1j * angle), np.exp(1j * angle[0]), atol=1e-5)
        angles.append(angle[0])
    np.testing.assert_allclose(
        np.quantile(np.array(angles) % (2 * np.pi), [0.25, 0.5, 0.75]) / np.pi, [0.5, 1, 1.5], atol=0.2
    )


def test_some_scans_stay_whole_some_lose_rings_and_some_lose_points_of_all_rings(varied):
    rings = [np.unique(labels % 64) for _, _, labels in varied]
    whole = np.array([len(labels) == len(points) for points, _, labels in varied])
    fewer = np.array(
        [
            len(found) in (32, 16) and len(labels) == 40 * len(found)
            for (*_, labels), found in zip(varied, rings, strict=True)
        ]
    )
    share_left = np.array([len(labels) / len(points) for points, _, labels in varied])[~whole & ~fewer]
    assert 0.22 < whole.mean() < 0.38 and 0.22 < fewer.mean() < 0.38
    assert {len(found) for found, is_fewer in zip(rings, fewer, strict=True) if is_fewer} == {32, 16}
    assert 0.04 < share_left.min() < 0.12 and 0.88 < share_left.max() < 1
    np.testing.assert_allclose(np.median(share_left), 0.525, atol=0.12)


def test_a_scan_without_rings_keeps_all_points_or_loses_random_ones():
    rng = np.random.default_rng(1)
    left = []
    for _ in range(60):
        points = rng.uniform(-20, 20, (500, 3)).astype(np.float32)
        left.append(len(vary(points, np.arange(500), None)[1]) / 500)
    assert 0.4 < np.mean(np.array(left) == 1) < 0.8 and min(left) < 0.5


def test_the_scan_alone_decides(varied):
    points, turned, labels = varied[7]
    again, same = vary(points.copy(), np.arange(len(points)), None)
    np.testing.assert_array_equal(again, turned)
    np.testing.assert_array_equal(same, labels)
    assert len({turned.tobytes() for _, turned, _ in varied}) == SCANS


def test_a_scan_is_levelled_before_it_is_turned():
    mounting = Mounting(height_m=0.73)
    for points, numbers in scans(3):
        turned, labels = vary(points, numbers, mounting)
        np.testing.assert_allclose(turned[:, 2], points[labels, 2] - 1.0, atol=1e-5)


@pytest.mark.slow
def test_images_are_those_of_varied_scans(tmp_path):
    options = {"routes": ["08"], "scans": 4, "azimuth_steps": 60, "seed": 1, "images": True}
    root = simulate(tmp_path / "varied", vary=True, **options).root
    drive = simulate_recording("08", scans=4, sensor=_lidar("hdl64e", 60), seed=1)
    images = open_recording(root, "08")
    for i in range(4):
        points, labels = vary(drive.points(i), drive.labels(i), None)
        expected = np.rot90(density_image(points), -1) * np.float32(10 / 255)
        np.testing.assert_array_equal(images.image(i), expected)
        shown = np.rot90(density_label_image(points, labels), -1)
        np.testing.assert_array_equal(images.labels(i), np.where(expected > 0, shown, 0))
        assert (images.image(i) != np.rot90(density_image(drive.points(i)), -1) * np.float32(10 / 255)).any()
    with pytest.raises(ValueError, match=r"layout images \(found varied\)"):
        simulate(root, **options)


def test_scans_are_not_varied(tmp_path):
    with pytest.raises(ValueError, match="vary: expected images, found scans"):
        simulate(tmp_path / "scans", routes=["08"], vary=True)
    assert not (tmp_path / "scans").exists()
