import numpy as np
import pytest

from sglpr_jax.evaluation.protocols.bootstrap import RESAMPLES, f1_max_interval, interval, resampled_means
from sglpr_jax.metrics import classification_curve, decision_curve


def f1_interval(scores, positive, query, seed=0):
    return f1_max_interval(
        scores,
        true_if_accepted=positive,
        false_if_accepted=~positive,
        missed_if_rejected=positive,
        query=query,
        seed=seed,
    )


@pytest.fixture
def pairs():
    """Scores, labels and query frames of 400 pairs; some queries have many."""
    rng = np.random.default_rng(0)
    positive = rng.random(400) < 0.4
    query = rng.integers(60, size=400) * 3 + 10
    return rng.normal(size=400) + positive + 0.5 * (query % 2), positive, query


def test_the_interval_is_that_of_resampling_in_a_loop(pairs):
    scores, positive, query = pairs
    rng = np.random.default_rng(1)
    frames = np.unique(query)
    resamples = []
    for _ in range(RESAMPLES):
        items = np.concatenate([np.flatnonzero(query == frame) for frame in rng.choice(frames, len(frames))])
        resamples.append(classification_curve(scores[items], positive[items]).f1_max)
    assert f1_interval(scores, positive, query) == pytest.approx(interval(np.array(resamples)), abs=0.015)


def test_answers_that_count_for_nothing_are_resampled_too():
    rng = np.random.default_rng(0)
    outcome = rng.integers(4, size=200)  # right, not counted, wrong though there is a revisit, wrong
    scores = rng.normal(size=200) + 0.5 * (outcome < 2)
    flags = {
        "true_if_accepted": outcome == 0,
        "false_if_accepted": outcome > 1,
        "missed_if_rejected": outcome < 3,
    }
    resamples = []
    for items in rng.integers(200, size=(RESAMPLES, 200)):
        chosen = {name: flag[items] for name, flag in flags.items()}
        resamples.append(decision_curve(scores[items], **chosen).f1_max)
    found = f1_max_interval(scores, **flags, query=np.arange(200), seed=0)
    assert found == pytest.approx(interval(np.array(resamples)), abs=0.015)


def test_pairs_of_one_query_are_worth_less_than_pairs_of_many(pairs):
    scores, positive, query = pairs
    apart, together = (np.ptp(f1_interval(scores, positive, q)) for q in (np.arange(400), query // 60))
    assert together < 1.5 * apart  # three lumps of many pairs each are nearly alike
    same = np.tile(scores[:20], 20), np.tile(positive[:20], 20)
    lumps, singles = (np.ptp(f1_interval(*same, q)) for q in (np.tile(np.arange(20), 20), np.arange(400)))
    assert lumps > 2 * singles  # twenty copies of twenty pairs tell no more than twenty pairs


def test_a_share_is_resampled_as_drawing_does():
    found = np.arange(200) < 150
    low, high = interval(resampled_means(found, np.random.default_rng(0)))
    spread = 1.96 * np.sqrt(0.75 * 0.25 / 200)
    assert (low, high) == pytest.approx((0.75 - spread, 0.75 + spread), abs=0.01)


def test_ties_and_answers_never_given():
    scores = np.array([1.0, 1.0, 1.0, -np.inf])
    low, high = f1_interval(scores, np.array([True, False, True, True]), np.arange(4))
    assert 0 <= low <= 2 * 2 / (2 * 2 + 1 + 1) <= high <= 1
