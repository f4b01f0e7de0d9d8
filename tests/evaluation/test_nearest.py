"""The nearest descriptors of each query, by the distance that a descriptor file names."""

from dataclasses import replace

import numpy as np
import pytest

from sglpr_jax.evaluation.protocols import PROTOCOLS, protocols_taking
from sglpr_jax.evaluation.protocols.nearest import nearest_descriptors
from sglpr_jax.evaluation.protocols.pairs import pair_distances
from sglpr_jax.retrieval.distances import distance_function

from .by_the_letter import random_drive


@pytest.mark.parametrize("name", [*protocols_taking("descriptors"), *protocols_taking("sessions")])
def test_cosine_is_l2_of_unit_length(make_file, name):
    positions, descriptors, times = random_drive(0, n=230)
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    by_cosine = replace(make_file(positions, descriptors, times=times), distance="cosine")
    of_unit_length = replace(by_cosine, descriptors=descriptors / lengths, distance="l2")

    def scored(file):
        if "sessions" not in PROTOCOLS[name].takes:
            return PROTOCOLS[name](file).score
        other = replace(file, descriptors=file.descriptors[::-1], positions=file.positions[::-1] + 2.0)
        return PROTOCOLS[name](file, other).score

    expected = scored(of_unit_length)
    assert scored(by_cosine) == pytest.approx(expected, abs=1e-6)
    assert expected > 0.05


@pytest.mark.slow
def test_a_distance_between_sets_serves_for_pairs_and_for_neighbours(make_file):
    rng = np.random.default_rng(0)
    rows = rng.uniform(size=(90, 1200)).astype(np.float32)
    file = replace(make_file(np.zeros((90, 3)), rows), distance="scan-context")
    table = distance_function("scan-context")(rows, rows)
    pairs = rng.integers(90, size=(2, 700))
    np.testing.assert_allclose(pair_distances(file, pairs), table[pairs[0], pairs[1]], atol=1e-6)
    ends = np.arange(1, 91)
    nearest, best = nearest_descriptors(rows, rows, ends, k=3, distance="scan-context")
    for i in range(3, 90):
        np.testing.assert_array_equal(nearest[i], np.argsort(table[i, : i + 1])[:3])
    np.testing.assert_allclose(best, table[np.arange(90), nearest[:, 0]], atol=1e-6)


def test_far_from_zero_the_nearest_are_still_found():
    rng = np.random.default_rng(0)
    rows = (1000 + rng.normal(size=(300, 64))).astype(np.float32)
    nearest, _ = nearest_descriptors(rows[150:], rows, np.full(150, 150), k=3)
    apart = np.linalg.norm(rows[150:, None].astype(np.float64) - rows[None, :150], axis=2)
    np.testing.assert_array_equal(nearest, np.argsort(apart, axis=1)[:, :3])
