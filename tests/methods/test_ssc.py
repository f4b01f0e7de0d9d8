import math

import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.methods.handcrafted.ssc import best_move, best_shift, ssc, ssc_distance

PRIORITY = {9: 10, 10: 11, 11: 12, 12: 13, 13: 15, 14: 16, 15: 14, 16: 17, 17: 9, 18: 18, 19: 19}
LANDMARKS = (13, 14, 16, 18, 19)
RING_M = 45 / 24


def in_loops(points, classes):
    """The descriptor from its definition, point by point."""
    cells, ranges, kinds = np.zeros((24, 360)), np.full(360, np.inf), np.zeros(360)
    for (x, y, _), category in zip(points.tolist(), classes.tolist(), strict=True):
        radius = math.hypot(x, y)
        sector = math.floor(math.degrees(math.atan2(y, x)) % 360) % 360
        ring = math.floor((radius - 5) / RING_M)
        if 0 <= ring < 24:
            cells[ring, sector] = max(cells[ring, sector], PRIORITY.get(category, 0))
        if category in LANDMARKS and 0 < radius < ranges[sector]:
            ranges[sector], kinds[sector] = radius, category
    return cells, np.where(np.isfinite(ranges), ranges, 0), kinds


def distance_in_loops(query, other):
    """Yaw, then move, then the share of equal cells, loop by loop."""
    (cells_q, ranges_q, kinds_q), (cells_d, ranges_d, kinds_d) = (
        (row[:8640].reshape(24, 360), row[8640:9000], row[9000:]) for row in (query, other)
    )
    costs = [sum(abs(ranges_q[j] - ranges_d[(j + s) % 360]) for j in range(360)) for s in range(360)]
    shift = costs.index(min(costs))
    ranges_d, kinds_d = np.roll(ranges_d, -shift), np.roll(kinds_d, -shift)
    directions = np.exp(1j * np.radians(np.arange(360) + 0.5))
    fixed, landmarks, move = ranges_q * directions, ranges_d * directions, 0j
    for _ in range(20):
        differences = []
        for j in np.flatnonzero(kinds_d):
            window = [(j + step) % 360 for step in range(-10, 11)]
            to_fixed = [fixed[k] - landmarks[j] - move for k in window if kinds_q[k] == kinds_d[j]]
            if to_fixed:
                differences.append(min(to_fixed, key=abs))
        move += np.mean(differences) if differences else 0
    both = equal = 0
    for ring in range(24):
        for sector in range(360):
            place = (5 + RING_M * (ring + 0.5)) * directions[sector] - move
            there = math.floor((abs(place) - 5) / RING_M)
            found = 0
            if 0 <= there < 24:
                found = cells_d[there, (math.floor(np.degrees(np.angle(place)) % 360) + shift) % 360]
            both += cells_q[ring, sector] > 0 and found > 0
            equal += cells_q[ring, sector] == found > 0
    return 1 - equal / max(both, 1)


def test_the_descriptor_is_the_first_class_of_each_cell_and_the_outline(places):
    rng = np.random.default_rng(0)
    random = rng.uniform(-55, 55, (3000, 3)).astype(np.float32), rng.integers(0, 20, 3000).astype(np.int32)
    for points, classes in (places[0], random):
        expected = np.concatenate([part.ravel() for part in in_loops(points, classes)])
        np.testing.assert_allclose(ssc(points, classes), expected, rtol=1e-6)


@pytest.mark.slow
def test_the_distance_is_the_one_described(places, turn_points):
    (points, classes), other = places[0], places[1]
    moved = turn_points(points + np.float32([1.2, -0.7, 0]), 2.5)
    rows = np.stack([ssc(points, classes), ssc(moved, classes), ssc(*other), np.zeros(9360, np.float32)])
    found = ssc_distance(rows[:1], rows)[0]
    # A centre that comes to lie on a border may fall to either side.
    np.testing.assert_allclose(found, [distance_in_loops(rows[0], row) for row in rows], atol=3e-3)
    assert found[0] == 0 and found[3] == 1
    assert found[1] < found[2] - 0.2


@pytest.mark.slow
def test_turn_and_move_are_found(places, turn_points):
    points, classes = places[0]
    here = ssc(points, classes)
    turned = ssc(turn_points(points, np.radians(77)), classes)
    shift = best_shift(jnp.asarray(here[8640:9000]), jnp.asarray(turned[8640:9000]))
    assert abs(int(shift) - 77) <= 1
    move = np.float32([0.8, -0.5, 0])
    there = ssc(points - move, classes)
    found = best_move(jnp.asarray(here[8640:].reshape(2, 360)), jnp.asarray(there[8640:].reshape(2, 360)))
    np.testing.assert_allclose(found, move[:2], atol=0.3)


@pytest.mark.parametrize("classes", [np.zeros(40), np.full(40, 1), np.full(40, 9)])
def test_scans_without_landmarks_can_be_compared(classes):
    points = np.random.default_rng(0).uniform(-30, 30, (40, 3)).astype(np.float32)
    row = ssc(points, classes.astype(np.int32))[None]
    # Classes that move or have no label leave nothing to compare; road is compared without being aligned.
    np.testing.assert_array_equal(ssc_distance(row, row), [[0.0 if classes[0] == 9 else 1.0]])
