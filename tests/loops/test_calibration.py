"""Pairs that are certain by odometry alone, what a model makes of them, and bins against counts by hand."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sglpr_jax.data.scan_stream import only
from sglpr_jax.loops.calibration import (
    EDGES,
    _Drive,
    calibrated,
    calibration_error,
    certain_pairs,
    reliability,
    reliability_of,
)
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.comparison import Candidate
from sglpr_jax.loops.probability import AdditiveModel, Curve, Evidence, LoopModel, default_model


@pytest.mark.slow
def test_certain_pairs_are_told_apart_and_a_model_fits_them(street, params):
    odometry = street.poses.world_from_lidar
    model = calibrated(params, street, odometry, pairs=15, seed=1)
    assert "others of 08" in model.made_with and default_model().made_with in model.made_with
    evidence, is_loop = certain_pairs(params, street, odometry, pairs=15, seed=2)
    assert 10 <= is_loop.sum() <= 15 and 10 <= (~is_loop).sum() <= 15
    assert np.nanmedian(evidence.ambiguity_ratio[is_loop]) < 0.7 < np.nanmedian(evidence.ambiguity_ratio[~is_loop])
    assert np.median(evidence.along_m[is_loop]) < np.median(evidence.along_m[~is_loop])
    probability = model.probability(evidence)
    assert probability[is_loop].mean() > 0.8 and probability[~is_loop].mean() < 0.2


def test_images_are_compared_without_the_background_as_in_a_search(street, params):
    few = only(street, range(2))
    stored, finder = _Drive(params, few, street.poses.world_from_lidar[:2]).stored, CandidateSearch(params)
    finder.add_keyframe(finder.keyframe(few.scan(0, labels=False)))
    np.testing.assert_array_equal(stored.image(0), finder.stored.image(0))


def test_odometry_of_another_length_or_of_a_vehicle_that_stands_still_is_refused(street, params):
    few = only(street, range(5))
    with pytest.raises(ValueError, match="08: expected odometry of 5 scans, found odometry of 3"):
        calibrated(params, few, street.poses.world_from_lidar[:3])
    with pytest.raises(ValueError, match="08: expected frames 2 to 10 m apart"):
        calibrated(params, few, np.tile(np.eye(4), (5, 1, 1)), pairs=2)


def test_bins_are_counted():
    probability = np.array([0.0, 0.005, 0.2, 0.99, 1.0, 0.985])
    is_loop = np.array([False, False, True, True, True, False])
    found = reliability(probability, is_loop)
    assert [(b.low, b.high, b.pairs, b.loops) for b in found] == [
        (0.0, 0.01, 2, 0),
        (0.1, 0.3, 1, 1),
        (0.9, 0.99, 1, 0),
        (0.99, 1.0, 2, 2),
    ]
    error = sum(b.pairs * abs(b.probability - b.share) for b in found) / 6
    assert calibration_error(found) == pytest.approx(error)
    assert (
        found[-1].probability == pytest.approx(0.995)
        and found[-1].share == 1
        and found[1].probability == pytest.approx(0.2)
    )


@given(st.lists(st.tuples(st.floats(0, 1), st.booleans()), max_size=60))
@example(3 * [(0.99, False)])  # the mean of which is rounded to less
def test_every_pair_is_in_one_bin(pairs):
    probability, is_loop = np.array([p for p, _ in pairs]), np.array([loop for _, loop in pairs], bool)
    found = reliability(probability, is_loop)
    assert sum(b.pairs for b in found) == len(pairs) and sum(b.loops for b in found) == is_loop.sum()
    assert all(b.low <= b.probability <= b.high and b.pairs for b in found)
    assert {edge for b in found for edge in (b.low, b.high)} <= set(EDGES)


def test_candidates_with_true_positions_and_those_in_between_are_left_out():
    model = LoopModel(AdditiveModel({"surprise": Curve((-9.0, 9.0), (-9.0, 9.0))}, 0.0), "by hand")
    positions = np.zeros((6, 3))
    positions[3:, 0] = 3, 15, 40
    candidates = [Candidate(q, 0, None, Evidence.of(0.0, 0.0, 0.0, c)) for q, c in ((3, 6.0), (4, 6.0), (5, -6.0))]
    low, high = reliability_of(candidates, model, positions)
    assert (low.pairs, low.loops, high.pairs, high.loops) == (1, 0, 1, 1)
    assert high.probability == pytest.approx(1 / (1 + np.exp(-6)))
    assert reliability_of([], model, positions) == () == reliability_of(candidates[1:2], model, positions)
