import numpy as np
import pytest

from sglpr_jax.evaluation.false_positives import worst_false_positives
from sglpr_jax.evaluation.protocols.protocol import Decision
from sglpr_jax.evaluation.protocols.recall import BEVPLACE_RECALL_AT_1
from sglpr_jax.evaluation.protocols.top1 import OVERLAP_TRANSFORMER_F1MAX, TOP1_F1MAX


@pytest.fixture
def mistaken(make_file, two_laps):
    """Two laps of which frames 500 and 501 look like 10 and 11, and 600 almost like 20; 700 meets its own place."""
    descriptors = two_laps / 200
    descriptors[[500, 501]] = descriptors[[10, 11]]
    descriptors[600] = descriptors[20] + [0.001, 0, 0]
    descriptors[700] += [0.01, 0, 0]
    return make_file(two_laps, descriptors)


@pytest.mark.parametrize("protocol", [TOP1_F1MAX, OVERLAP_TRANSFORMER_F1MAX])
def test_the_surest_mistakes_come_first_and_neighbours_once(mistaken, protocol):
    result = protocol(mistaken)
    assert np.sum(result.decisions == Decision.FALSE_POSITIVE) == 3
    first, second = worst_false_positives(result, mistaken.positions)
    assert (first.query, first.answer, first.distance) == (500, 10, 0)
    assert (second.query, second.answer) == (600, 20)
    assert second.distance == pytest.approx(0.001, rel=1e-3)
    assert second.metres == pytest.approx(np.linalg.norm(mistaken.positions[600] - mistaken.positions[20]))
    assert worst_false_positives(result, mistaken.positions, most=1) == [first]


def test_metres_have_the_dimensions_of_the_protocol(mistaken):
    hills = mistaken.positions + np.arange(800)[:, None] * [0, 0, 1.0]
    flat = OVERLAP_TRANSFORMER_F1MAX(mistaken)
    assert flat.dimensions == 2
    assert worst_false_positives(flat, hills) == worst_false_positives(flat, mistaken.positions)


def test_a_recall_accepts_nothing_and_a_perfect_method_nothing_wrong(mistaken, make_file, two_laps):
    assert worst_false_positives(BEVPLACE_RECALL_AT_1(mistaken), mistaken.positions) == []
    assert worst_false_positives(TOP1_F1MAX(make_file(two_laps, two_laps)), two_laps) == []


def test_every_query_has_its_answer_in_the_result(mistaken):
    result = TOP1_F1MAX(mistaken)
    assert result.answers.shape == result.answer_distances.shape == (800,)
    queries = result.decisions != Decision.NOT_A_QUERY
    assert np.all(result.answers[~queries] == -1) and np.all(np.isinf(result.answer_distances[~queries]))
    assert np.all(result.answers[queries] < np.flatnonzero(queries))
    apart = np.linalg.norm(mistaken.descriptors[queries] - mistaken.descriptors[result.answers[queries]], axis=1)
    np.testing.assert_allclose(result.answer_distances[queries], apart, atol=1e-6)
