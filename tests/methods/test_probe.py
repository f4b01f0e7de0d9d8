import math

import numpy as np
import pytest

from sglpr_jax.methods.handcrafted.probe import MOVE_M, occupancy, probe, probe_distance


def in_loops(points):
    heights = np.zeros((40, 60))
    for x, y, z in points.astype(float):
        radius = math.hypot(x, y)
        if radius < 80 and z + 1.73 > 0.3:
            cell = int(radius / 2), int(math.degrees(math.atan2(y, x)) % 360 // 6) % 60
            heights[cell] = max(heights[cell], z + 1.73)
    return heights


def blurred(heights):
    """Probability of occupancy, sector by sector."""
    found = np.zeros((40, 60))
    for r in range(40):
        deviation = math.degrees(MOVE_M / (2 * r + 1))
        apart = np.array([6 * min(s, 60 - s) for s in range(60)])
        kernel = np.exp(-((apart / deviation) ** 2) / 2)
        for s in range(60):
            found[r, s] = sum((heights[r, t] > 0) * kernel[(s - t) % 60] for t in range(60)) / kernel.sum()
    return found


def distance_in_loops(a, b):
    cosines = [np.sum(a * np.roll(b, -s, axis=1)) / np.linalg.norm(a) / np.linalg.norm(b) for s in range(60)]
    b = np.roll(b, -int(np.argmax(cosines)), axis=1)
    p, q = blurred(a), blurred(b)
    agreed = either = 0.0
    for r in range(40):
        deviation = MOVE_M / (2 * r + 1)
        u = min(deviation, 1)
        s, t = (np.clip((1 - u) * x[r] + u / 2, 0.01, 0.99) for x in (p, q))
        divergence = kl(s, t) + kl(t, s)
        union = math.exp(-math.degrees(deviation) / 6) * np.maximum(p[r], q[r])
        agreed, either = agreed + np.sum(union * np.exp(-divergence)), either + union.sum()
    return 1 - max(cosines) * agreed / either


def kl(p, q):
    return p * np.log(p / q) + (1 - p) * np.log((1 - p) / (1 - q))


@pytest.fixture(scope="module")
def rows(places):
    return np.stack([probe(points) for points, _ in places])


def test_the_descriptor_is_the_greatest_height_of_each_cell(places):
    rng = np.random.default_rng(0)
    wide = np.column_stack([rng.uniform(-90, 90, (2000, 2)), rng.uniform(-3, 5, 2000)]).astype(np.float32)
    for points in (places[0][0], wide):
        np.testing.assert_allclose(probe(points).reshape(40, 60), in_loops(points), atol=1e-5)


def test_occupancy_is_a_blur_that_keeps_the_sum_of_a_ring(rows):
    heights = rows.reshape(-1, 40, 60)
    found = occupancy(heights)
    np.testing.assert_allclose(found[0], blurred(heights[0]), atol=1e-9)
    np.testing.assert_allclose(found.sum(-1), (heights > 0).sum(-1), atol=1e-9)
    assert found.min() >= 0 and found.max() <= 1


def test_the_distance_is_its_formula(rows):
    scans = rows.reshape(-1, 40, 60).astype(float)
    expected = [[distance_in_loops(a, b) for b in scans[:3]] for a in scans[:2]]
    np.testing.assert_allclose(probe_distance(rows[:2], rows[:3]), expected, atol=1e-5)


def test_whole_sectors_of_turn_change_nothing(rows):
    turned = np.stack([np.roll(rows.reshape(-1, 40, 60), turn, axis=2) for turn in range(60)]).reshape(60 * 4, -1)
    expected = np.tile(probe_distance(rows, rows), (60, 1))
    np.testing.assert_allclose(probe_distance(turned, rows), expected, atol=1e-4)


def test_an_empty_scan_has_nothing_in_common_with_any(rows):
    empty = np.zeros((1, 2400), np.float32)
    np.testing.assert_array_equal(probe_distance(empty, np.concatenate([rows, empty])), 1)
