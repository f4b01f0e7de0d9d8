import sys

import numpy as np
import pytest

from sglpr_jax.evaluation import pairwise
from sglpr_jax.evaluation.baselines import BASELINES, lidar_iris, scan_context, ssc
from sglpr_jax.evaluation.distances import DISTANCES, cosine, distance_function, l2


@pytest.fixture
def rows() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(9, 5)).astype(np.float32)


def test_l2_is_the_euclidean_distance_even_where_it_is_tiny(rows):
    near = rows + np.float32(1e-4)
    expected = np.linalg.norm(rows[:, None].astype(np.float64) - near[None], axis=-1)
    np.testing.assert_allclose(l2(rows, near), expected, rtol=1e-4)


def test_cosine_is_the_cosine_distance(rows):
    zero = np.zeros((1, 5), np.float32)
    expected = [[1 - a @ b / np.linalg.norm(a) / np.linalg.norm(b) for b in rows] for a in 2 * rows]
    np.testing.assert_allclose(cosine(2 * rows, rows), expected, atol=1e-6)
    assert (cosine(zero, rows) == 1).all() and (cosine(rows, zero) == 1).all()


def test_every_baseline_has_a_distance():
    assert {baseline.distance for baseline in BASELINES.values()} <= set(DISTANCES)


def test_an_unknown_distance_is_named_with_the_nearest_one():
    with pytest.raises(ValueError, match=r"l2, cosine, .*, found 'scan_context'; did you mean scan-context\?"):
        distance_function("scan_context")


@pytest.mark.parametrize("q, n", [(1, 1), (5, 3), (4, 9), (0, 3)])
def test_blocks_cover_every_pair_once(rows, q, n):
    calls = []

    def compare(a, b):
        calls.append((len(a), len(b)))
        return (a[:, None] - 2 * b[None]).sum(-1)

    found = pairwise.in_blocks(compare, rows[:q], rows[:n], block=4, prepare=lambda part: 3 * part)
    expected = 3 * (rows[:q, None] - 2 * rows[None, :n]).sum(-1)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    assert sum(a * b for a, b in calls) == q * n and max([0, *(max(call) for call in calls)]) <= 4


def test_correlation_is_the_sum_it_says():
    rng = np.random.default_rng(0)
    queries, database = (rng.normal(size=(n, 3, 7)).astype(np.float32) for n in (2, 4))
    found = pairwise.correlate(queries, database)
    for q, d, shift in np.ndindex(2, 4, 7):
        expected = sum(queries[q, r, j] * database[d, r, (j + shift) % 7] for r in range(3) for j in range(7))
        assert found[q, d, shift] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("name", sorted(DISTANCES))
def test_blocks_change_no_distance(places, monkeypatch, name):
    rows = {
        "scan-context": lambda points, _: scan_context(points),
        "lidar-iris": lambda points, _: lidar_iris(points),
        "ssc": ssc,
    }.get(name, lambda points, _: points[:4].ravel())
    everything = np.stack([rows(*place) for place in places])
    whole = DISTANCES[name](everything, everything)
    monkeypatch.setattr(sys.modules[DISTANCES[name].__module__], "BLOCK", 2)
    np.testing.assert_allclose(DISTANCES[name](everything, everything), whole, atol=1e-5)
