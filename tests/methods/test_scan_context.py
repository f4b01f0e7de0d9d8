import math

import numpy as np
import pytest

from sglpr_jax.methods.handcrafted.scan_context import scan_context, scan_context_distance


def in_loops(points):
    """Scan Context from its definition, point by point."""
    highest = [[None] * 60 for _ in range(20)]
    for x, y, z in points.tolist():
        radius, degrees = math.hypot(x, y), math.degrees(math.atan2(y, x)) % 360
        if radius > 80:
            continue
        ring = min(max(math.ceil(radius / 80 * 20), 1), 20) - 1
        sector = min(max(math.ceil(degrees / 360 * 60), 1), 60) - 1
        height = z + 2.0
        highest[ring][sector] = height if highest[ring][sector] is None else max(height, highest[ring][sector])
    return np.array([[0 if height is None else height for height in row] for row in highest])


def distance_in_loops(query, other):
    """Equations 6 and 7, column by column."""
    best = 1.0
    for shift in range(60):
        cosines = []
        for j in range(60):
            a, b = query[:, j], other[:, (j + shift) % 60]
            if np.linalg.norm(a) > 0 and np.linalg.norm(b) > 0:
                cosines.append(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))
        if cosines:
            best = min(best, 1 - sum(cosines) / len(cosines))
    return best


def test_the_descriptor_is_the_greatest_height_of_each_cell(places):
    rng = np.random.default_rng(1)
    wide = np.column_stack([rng.uniform(-90, 90, (500, 2)), rng.uniform(-3, 5, 500)]).astype(np.float32)
    for points in (places[0][0], wide):
        np.testing.assert_allclose(scan_context(points).reshape(20, 60), in_loops(points), atol=1e-5)


@pytest.mark.parametrize(
    ("point", "ring", "sector", "height"),
    [
        ((4.0, 0.0, 1.0), 0, 0, 3.0),  # on the far border of the first ring; angle 0 counts for the first sector
        ((4.001, 1e-3, 1.0), 1, 0, 3.0),
        ((0.0, 80.0, -5.0), 19, 14, -3.0),  # below the ground, yet the only point: not 0; 90 degrees end sector 15
        ((10.0, -1e-3, 0.0), 2, 59, 2.0),
    ],
)
def test_borders_belong_to_the_inner_ring_and_the_earlier_sector(point, ring, sector, height):
    found = scan_context(np.array([point], np.float32)).reshape(20, 60)
    assert np.argwhere(found).tolist() == [[ring, sector]]
    assert found[ring, sector] == pytest.approx(height)


@pytest.mark.slow
def test_the_distance_is_the_papers(places):
    rng = np.random.default_rng(2)
    rows = np.stack([scan_context(points) for points, _ in places]).reshape(-1, 20, 60)
    sparse = rows * (rng.random((4, 1, 60)) < 0.4)  # many empty columns, of which each pair shares others
    everything = np.concatenate([rows, sparse, np.zeros((1, 20, 60))]).astype(np.float32)
    expected = [[distance_in_loops(a, b) for b in everything] for a in everything[:5]]
    found = scan_context_distance(everything[:5].reshape(5, -1), everything.reshape(len(everything), -1))
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert (found[:, -1] == 1).all()  # nothing in common with an empty scan


def test_whole_sectors_of_turn_change_nothing(places):
    rows = np.stack([scan_context(points) for points, _ in places])
    turned = np.stack([np.roll(rows.reshape(-1, 20, 60), turn, axis=2) for turn in range(60)]).reshape(60 * 4, -1)
    expected = np.tile(scan_context_distance(rows, rows), (60, 1))
    np.testing.assert_allclose(scan_context_distance(turned, rows), expected, atol=1e-5)
