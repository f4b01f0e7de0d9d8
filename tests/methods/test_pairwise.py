"""Blocks of pairs, and correlations over all shifts."""

import threading

import numpy as np
import pytest

from sglpr_jax.methods.pairwise import correlate, in_blocks

ROWS = np.random.default_rng(0).normal(size=(9, 5)).astype(np.float32)


@pytest.mark.parametrize("q, n", [(1, 1), (5, 3), (4, 9), (0, 3)])
def test_blocks_cover_every_pair_once(q, n):
    calls = []

    def compare(a, b):
        calls.append((len(a), b.shape[1]))
        return a @ b

    options = {"prepare": lambda part: 3 * part, "prepare_database": lambda part: part.T}
    found = in_blocks(compare, ROWS[:q], ROWS[:n], block=4, **options)
    np.testing.assert_allclose(found, 3 * ROWS[:q] @ ROWS[:n].T, rtol=1e-5, atol=1e-5)
    assert sum(a * b for a, b in calls) == q * n and max([0, *(max(call) for call in calls)]) <= 4


def test_blocks_at_once_are_those_one_after_another_and_raise_their_errors():
    together = threading.Barrier(2, timeout=60)  # breaks where one block waits for the other

    def compare(a, b):
        together.wait()
        return a @ b.T

    found = in_blocks(compare, ROWS, ROWS[:8], block=4, threads=2)
    np.testing.assert_allclose(found, ROWS @ ROWS[:8].T, rtol=1e-5, atol=1e-5)
    with pytest.raises(ZeroDivisionError):
        in_blocks(lambda a, b: a / (1 // 0), ROWS, ROWS, block=4, threads=None)


def test_correlation_is_the_sum_it_says():
    rng = np.random.default_rng(0)
    queries, database = (rng.normal(size=(n, 3, 7)).astype(np.float32) for n in (2, 4))
    rolled = np.stack([np.roll(database, -shift, axis=2) for shift in range(7)])
    np.testing.assert_allclose(correlate(queries, database), np.einsum("qrj,snrj->qns", queries, rolled), atol=1e-5)
