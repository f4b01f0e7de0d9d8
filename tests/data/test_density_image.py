"""Density images: against the recipe spelled out point by point, and against the images rendered from real scans."""

import math
import tracemalloc
from collections import defaultdict

import numpy as np
import pytest
from PIL import Image

from sglpr_jax.data.density_image import density_bev, density_image, density_label_image
from sglpr_jax.data.readers.bev_images import read_image


def cloud(*points: tuple[float, float, float]) -> np.ndarray:
    return np.array(points, np.float32).reshape(-1, 3)


def reference_image(points: np.ndarray) -> tuple[np.ndarray, float]:
    """The recipe, one point at a time; the image and the edge of the voxels."""
    kept = [p for p in points if abs(p[0]) < 25 and abs(p[1]) < 25 and p[2] > -1.2 and np.isfinite(p).all()]
    for steps in range(2, 100):
        voxels = defaultdict(list)
        for p in kept:
            voxels[tuple(np.floor(p * np.float32(1 / (0.05 * steps))))].append(p.astype(np.float64))
        if len(voxels) <= 6000:
            break
    counts = np.zeros((151, 151))
    for members in voxels.values():
        x, y, _ = np.mean(members, axis=0)
        counts[75 - math.trunc(x / 0.4), 75 - math.trunc(y / 0.4)] += 1
    counts = np.minimum(counts, 10)
    return np.round(counts / max(counts.max(), 1) * 255).astype(np.uint8), 0.05 * steps


@pytest.mark.slow
@pytest.mark.parametrize(("n", "spread_m", "edge_m"), [(500, 12.0, 0.10), (9000, 12.0, 0.70)])
def test_images_follow_the_recipe_at_every_edge(n, spread_m, edge_m):
    points = np.random.default_rng(n).normal(scale=[spread_m, spread_m, 1.0], size=(n, 3)).astype(np.float32)
    points[::100, 0] = np.nan
    expected, edge_found = reference_image(points)
    assert edge_found == pytest.approx(edge_m)
    np.testing.assert_array_equal(density_image(points), expected)


def test_a_point_high_in_the_air_takes_no_memory():
    points = np.random.default_rng(1).normal(scale=[8, 8, 1], size=(1000, 3)).astype(np.float32)
    points[7, 2] = 120.0
    tracemalloc.start()
    image = density_image(points)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_array_equal(image, reference_image(points)[0])
    assert peak < 2e8  # a flag for each voxel up there would take gigabytes


@pytest.mark.parametrize("outside", [(25.0, 0, 0), (0, 0, -1.2001), (np.nan, 0, 0), (0, 0, np.inf)])
def test_points_outside_the_crop_change_nothing(outside):
    points = cloud(outside)
    assert not density_image(points).any()
    assert not density_label_image(points, np.array([9])).any()
    assert density_image(np.concatenate([points, cloud((1.0, 1.0, 0.0))])).sum() == 255


def test_labels_are_those_of_the_last_point_inside_the_crop():
    points = cloud((5.1, 5.1, 0.0), (5.2, 5.2, 1.0), (5.2, 5.2, -1.7), (-5.1, 5.1, 0.0))
    labels = density_label_image(points, np.array([13, 14, 9, 1]))
    assert labels.dtype == np.int32
    assert {tuple(map(int, cell)): int(labels[tuple(cell)]) for cell in np.argwhere(labels)} == {
        (63, 63): 14,
        (87, 63): 1,
    }


@pytest.mark.parametrize("n", [0, 20_000])
def test_the_image_for_models_is_the_ready_made_one_that_would_be_read(n, tmp_path):
    points = np.random.default_rng(n).normal(scale=[9, 9, 1], size=(n, 3)).astype(np.float32)
    Image.fromarray(density_image(points)).save(tmp_path / "a.png")
    found = density_bev(points)
    np.testing.assert_array_equal(found, read_image(tmp_path / "a.png"))
    assert found.shape == (151, 151) and found.dtype == np.float32 and found.max() == (10 if n else 0)


def test_the_real_images_are_reproduced_pixel_for_pixel(shared):
    scans = sorted((shared / "data/kitti_odometry/sequences/00/velodyne").glob("*.bin"))
    assert scans
    for path in scans:
        points = np.fromfile(path, "<f4").reshape(-1, 4)[:, :3]
        expected = np.asarray(Image.open(shared / f"data/kitti_bev/00/imgs/{path.stem}.png"))
        np.testing.assert_array_equal(density_image(points), expected, err_msg=path.stem)
