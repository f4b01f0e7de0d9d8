"""What is drawn in blocks is what numpy draws from a list of all."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.evaluation.protocols.pairs import drawn_frame_pairs, frame_pairs
from sglpr_jax.evaluation.protocols.pairs_f1max import are_negative, pairs_f1max

from .by_the_letter import random_drive


@given(st.integers(0, 10_000), st.sampled_from([0, 1, 150, 190, 6000, 10**6]))
@settings(deadline=None, max_examples=15)
def test_pairs_are_those_that_are_drawn_from_a_list_of_all(seed, most):
    positions = 4 * random_drive(seed, n=200)[0][:, :2]  # most pairs are more than 20 m apart
    every = frame_pairs(positions, are_negative)
    expected = np.random.default_rng(seed).choice(every, min(most, len(every)), replace=False)
    found = drawn_frame_pairs(positions, are_negative, most=most, rng=np.random.default_rng(seed))
    np.testing.assert_array_equal(found, np.sort(expected))


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1, 100])
@pytest.mark.parametrize("distance", ["l2", "cosine"])
def test_a_score_is_the_one_of_the_plain_computation(make_file, two_laps, monkeypatch, ratio, distance):
    noise = np.random.default_rng(0).normal(scale=0.1, size=(800, 3))
    file = replace(make_file(two_laps, two_laps / 200 + noise), distance=distance)
    found = pairs_f1max(file, negatives_per_positive=ratio)

    def plainly(positions, keep, *, most, rng):
        every = frame_pairs(positions, keep)
        return rng.choice(every, min(most, len(every)), replace=False)

    monkeypatch.setattr("sglpr_jax.evaluation.protocols.pairs_f1max.drawn_frame_pairs", plainly)
    plain = pairs_f1max(file, negatives_per_positive=ratio)
    assert (found.score, found.interval, found.counts) == (plain.score, plain.interval, plain.counts)
    assert 0 < found.score < 1


def test_memory_grows_with_what_is_drawn():
    positions = np.arange(3000.0)[:, None] * [30.0, 0.0]
    tracemalloc.start()
    found = drawn_frame_pairs(positions, are_negative, most=80_000, rng=np.random.default_rng(0))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(found) == 80_000
    assert peak < 1.5e7  # a list of the 4.5 million pairs alone has 3.6e7
