import sys
import threading

import numpy as np
import pytest

from sglpr_jax.methods import pairwise
from sglpr_jax.methods.handcrafted.lidar_iris import lidar_iris
from sglpr_jax.methods.handcrafted.probe import probe
from sglpr_jax.methods.handcrafted.ring import ring
from sglpr_jax.methods.handcrafted.scan_context import scan_context
from sglpr_jax.methods.handcrafted.ssc import ssc, ssc_24
from sglpr_jax.retrieval.distances import DISTANCES


@pytest.fixture
def rows() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(9, 5)).astype(np.float32)


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


def test_the_database_may_be_prepared_in_another_way(rows):
    found = pairwise.in_blocks(
        lambda a, b: a @ b, rows, rows, block=4, prepare=lambda part: 2 * part, prepare_database=lambda part: part.T
    )
    np.testing.assert_allclose(found, 2 * rows @ rows.T, rtol=1e-5, atol=1e-5)


def test_blocks_at_once_are_those_one_after_another(rows):
    together = threading.Barrier(2, timeout=60)  # breaks where one block waits for the other

    def compare(a, b):
        together.wait()
        return a @ b.T

    found = pairwise.in_blocks(compare, rows, rows[:8], block=4, threads=2)
    np.testing.assert_allclose(found, rows @ rows[:8].T, rtol=1e-5, atol=1e-5)


def test_what_a_block_raises_is_raised(rows):
    def compare(a, b):
        raise ValueError("no such rows")

    with pytest.raises(ValueError, match="no such rows"):
        pairwise.in_blocks(compare, rows, rows, block=4, threads=None)


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
        "ring": lambda points, _: ring(points),
        "probe": lambda points, _: probe(points),
        "ssc": ssc,
        "ssc-24": ssc_24,
    }.get(name, lambda points, _: points[:4].ravel())
    everything = np.stack([rows(*place) for place in places])
    whole = DISTANCES[name](everything, everything)
    monkeypatch.setattr(sys.modules[DISTANCES[name].__module__], "BLOCK", 2)
    np.testing.assert_allclose(DISTANCES[name](everything, everything), whole, atol=1e-5)
