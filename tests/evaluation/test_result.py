import numpy as np
import pytest

from sglpr_jax.evaluation.protocols.result import RESAMPLES, percentile_interval, resampled_f1_max, resampled_means
from sglpr_jax.metrics import decision_curve


@pytest.mark.parametrize("pairs", [True, False])
def test_the_interval_equals_that_of_resampling_in_a_loop(pairs):
    rng = np.random.default_rng(0)
    if pairs:  # some queries have many
        positive = rng.random(400) < 0.4
        query = rng.integers(60, size=400) * 3 + 10
        scores = rng.normal(size=400) + positive + 0.5 * (query % 2)
        flags = {"true_if_accepted": positive, "false_if_accepted": ~positive, "missed_if_rejected": positive}
    else:
        outcome, query = rng.integers(4, size=200), np.arange(200)
        scores = rng.normal(size=200) + 0.5 * (outcome < 2)  # right, not counted, wrong despite a revisit, wrong
        flags = {"true_if_accepted": outcome == 0, "false_if_accepted": outcome > 1, "missed_if_rejected": outcome < 3}
    resamples, frames = [], np.unique(query)
    for _ in range(RESAMPLES):
        items = np.concatenate([np.flatnonzero(query == frame) for frame in rng.choice(frames, len(frames))])
        chosen = {name: flag[items] for name, flag in flags.items()}
        resamples.append(decision_curve(scores[items], **chosen).f1_max)
    found = percentile_interval(resampled_f1_max(scores, query=query, seed=0, **flags))
    assert found == pytest.approx(percentile_interval(np.array(resamples)), abs=0.015)


def test_resampled_means_equal_those_of_drawn_queries():
    found = np.arange(200) < 150
    low, high = percentile_interval(resampled_means(found, np.random.default_rng(0)))
    spread = 1.96 * np.sqrt(0.75 * 0.25 / 200)
    assert (low, high) == pytest.approx((0.75 - spread, 0.75 + spread), abs=0.01)
