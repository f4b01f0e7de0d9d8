"""Inputs of protocols: top-k lists and scored pairs instead of descriptors, and invalid inputs."""

from dataclasses import replace

import numpy as np
import pytest

from sglpr_jax.evaluation.protocols import PROTOCOLS, protocols_taking
from sglpr_jax.evaluation.protocols.pairs import LISTED_PAIRS_F1MAX, pair_distances
from sglpr_jax.evaluation.protocols.protocol import ScoredPairs, TopK, nearest_descriptors
from sglpr_jax.evaluation.protocols.recall import BEVPLACE_RECALL_AT_1, SSC_RECALL
from sglpr_jax.evaluation.protocols.result import Decision
from sglpr_jax.evaluation.protocols.top1 import SCAN_CONTEXT_F1MAX, TOP1_F1MAX
from sglpr_jax.retrieval.distances import distance_function

from .by_the_letter import random_drive


@pytest.fixture(scope="module")
def listed(noisy_laps) -> TopK:
    """Return a top-k list with all frames of the recording for each frame, best first."""
    file = noisy_laps
    apart = np.linalg.norm(file.descriptors[:, None] - file.descriptors[None], axis=2)
    nearest = np.argsort(apart, axis=1)
    scores = -np.take_along_axis(apart, nearest, axis=1).astype(np.float64)
    return TopK("town", file.positions, None, "made up", np.arange(800), nearest, scores)


# SSC's recall counts the rows of a list in another way: see below.
@pytest.mark.parametrize(
    "protocol", [other for name, other in protocols_taking("scored top-k list").items() if name != "ssc-recall"]
)
def test_a_list_has_the_score_of_its_descriptors(noisy_laps, listed, protocol):
    by_descriptors, by_list = protocol(noisy_laps), protocol(listed)
    assert by_list.score == pytest.approx(by_descriptors.score)
    assert by_list.interval == pytest.approx(by_descriptors.interval, abs=1e-3)
    assert by_list.recalls == pytest.approx(by_descriptors.recalls)
    assert by_list.counts == by_descriptors.counts
    np.testing.assert_array_equal(by_list.decisions, by_descriptors.decisions)


def test_ssc_recall_counts_every_listed_query(noisy_laps, listed):
    asked = SSC_RECALL(noisy_laps)
    queries = np.flatnonzero(asked.decisions)
    rows = replace(listed, queries=queries, nearest=listed.nearest[queries], scores=None)
    assert SSC_RECALL(rows).recalls == asked.recalls
    more = np.append(queries, 100)  # a frame of the first lap, with nothing to find
    result = SSC_RECALL(replace(listed, queries=more, nearest=listed.nearest[more], scores=None))
    assert result.counts == {"queries": len(more), "revisits": len(queries)}
    assert result.recalls[25] == pytest.approx(asked.recalls[25] * len(queries) / len(more))


def test_a_list_without_answers_scores_nothing(listed):
    empty = replace(listed, nearest=np.full((800, 1), -1), scores=np.zeros((800, 1)))
    for protocol in (TOP1_F1MAX, SCAN_CONTEXT_F1MAX, BEVPLACE_RECALL_AT_1):
        result = protocol(empty)
        assert (result.score, result.interval) == (0.0, (0.0, 0.0))
        assert not np.any(result.decisions == Decision.TRUE_POSITIVE)


def test_nearest_descriptors_are_exact_for_large_values():
    rng = np.random.default_rng(0)
    rows = (1000 + rng.normal(size=(300, 64))).astype(np.float32)
    nearest, _ = nearest_descriptors(rows[150:], rows, np.full(150, 150), k=3, distance="l2")
    apart = np.linalg.norm(rows[150:, None].astype(np.float64) - rows[None, :150], axis=2)
    np.testing.assert_array_equal(nearest, np.argsort(apart, axis=1)[:, :3])


def test_a_threshold_needs_scores(listed):
    with pytest.raises(ValueError, match="top-1 F1max: expected a list with scores"):
        TOP1_F1MAX(replace(listed, scores=None))
    assert BEVPLACE_RECALL_AT_1(replace(listed, scores=None)).score == BEVPLACE_RECALL_AT_1(listed).score


def test_pairs_without_labels_are_labelled_by_position(noisy_laps):
    pairs = np.array([[400, 0], [401, 0], [405, 0], [100, 0], [1, 0], [700, 300]])  # 0, 3.1, 16, 200, 3.1, 0 m
    scores, some = -pair_distances(noisy_laps, pairs.T), [0, 3, 5]
    given = LISTED_PAIRS_F1MAX(ScoredPairs(pairs[some], scores[some], np.array([True, False, True])))
    told = LISTED_PAIRS_F1MAX(ScoredPairs(pairs, scores, positions=noisy_laps.positions))
    assert told.counts == given.counts == {"positive pairs": 2, "negative pairs": 1}
    assert told.score == given.score == 1.0
    assert np.isnan(LISTED_PAIRS_F1MAX(ScoredPairs(pairs, np.zeros(6), np.zeros(6, dtype=bool))).score)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"queries": np.arange(800) // 2}, "found one listed twice"),
        ({"queries": np.arange(1, 801)}, "expected query frames from 0 to 799, found 800 in row 799"),
        ({"scores": np.full((800, 800), np.nan)}, "expected a finite score"),
    ],
)
def test_invalid_lists_are_refused(listed, change, error):
    with pytest.raises(ValueError, match=error):
        replace(listed, **change)
    with pytest.raises(ValueError, match=r"expected pairs of frames from 0 .* found -1 in row 1"):
        ScoredPairs(np.array([[5, 0], [-1, 3]]), np.zeros(2), np.array([True, False]))


@pytest.mark.parametrize("name", ["top1-f1max", "pairs-f1max", "ssc-recall", "bevplace-nclt-recall"])
def test_cosine_equals_l2_of_unit_vectors(make_file, name):
    positions, descriptors, times = random_drive(0, n=230)
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    by_cosine = replace(make_file(positions, descriptors, times=times), distance="cosine")
    of_unit_length = replace(by_cosine, descriptors=descriptors / lengths, distance="l2")

    def scored(file):
        other = replace(file, descriptors=file.descriptors[::-1], positions=file.positions[::-1] + 2.0)
        return PROTOCOLS[name](*([file, other] if "sessions" in PROTOCOLS[name].takes else [file])).score

    expected = scored(of_unit_length)
    assert scored(by_cosine) == pytest.approx(expected, abs=1e-6) and expected > 0.05


@pytest.mark.slow
def test_a_handcrafted_distance_works_for_pairs_and_for_nearest_descriptors(make_file):
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
