"""The monotone model: it says what the pairs say, it is bounded, and its file holds all of it."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sglpr_jax.loops.probability import (
    ALL,
    KNOTS,
    OF_REPETITION,
    RISING,
    Curve,
    Evidence,
    LoopModel,
    default_model,
    fit,
    recalibrated,
)


def pairs(n: int = 600, *, seed: int = 0, noise: float = 1.0, shift: float = 0.0) -> tuple[Evidence, np.ndarray]:
    """Pairs of which a third are loops, with evidence that overlaps."""
    rng = np.random.default_rng(seed)
    is_loop = rng.random(n) < 1 / 3
    draw = [rng.normal(scale=noise * s, size=n) for s in (0.2, 0.15, 0.6, 1.0)]
    peak, ambiguity = 0.9 - shift - 0.4 * is_loop + draw[0], 0.9 - 0.4 * is_loop + draw[1]
    deviation, surprise = np.abs(1.8 - is_loop + draw[2]), 2.0 + is_loop + draw[3]
    return Evidence(peak, ambiguity, deviation, surprise), is_loop


@pytest.mark.parametrize("names", [ALL, OF_REPETITION])
def test_probabilities_are_those_of_pairs_that_were_not_fitted(names):
    model = fit(*pairs(6000, noise=2.0), names=names)
    evidence, is_loop = pairs(6000, seed=1, noise=2.0)
    probabilities = model.probability(evidence)
    for low in np.arange(0, 1, 0.2):
        chosen = (probabilities >= low) & (probabilities < low + 0.2)
        assert abs(probabilities[chosen].mean() - is_loop[chosen].mean()) < 0.1


def test_the_fit_finds_the_curve_that_the_pairs_were_drawn_from():
    """Log odds that bend once, which a straight line cannot follow."""
    rng, n = np.random.default_rng(0), 40_000
    values = rng.uniform(0, 1.2, n)
    true = 4 * np.clip((0.8 - values) / 0.4, 0, 1) - 2
    is_loop = rng.random(n) < 1 / (1 + np.exp(-true))
    evidence = Evidence(*[values if name == "ambiguity_ratio" else np.full(n, 0.5) for name in ALL])
    model = fit(evidence, is_loop, names=("ambiguity_ratio",))
    np.testing.assert_allclose(model.log_odds(evidence), true, atol=0.35)


def test_weights_are_as_good_as_pairs_that_stand_several_times():
    evidence, is_loop = pairs(200)
    often = np.arange(200) % 3 + 1
    again = Evidence(*(np.repeat(values, often) for values in evidence))
    one = fit(evidence, is_loop, weights=often.astype(float))
    other = fit(again, np.repeat(is_loop, often))
    np.testing.assert_allclose(one.log_odds(evidence), other.log_odds(evidence), atol=0.02)


@given(values=st.lists(st.floats(-1, 6), min_size=8, max_size=8), name=st.sampled_from(ALL))
def test_log_odds_never_fall_where_the_evidence_is_stronger(values, name):
    one, other = (Evidence(*np.array(half)) for half in (values[:4], values[4:]))
    better = other._replace(**{field: getattr(one, field) for field in ALL if field != name})
    stronger = (
        getattr(better, name) >= getattr(one, name) if name in RISING else getattr(better, name) <= getattr(one, name)
    )
    low, high = (one, better) if stronger else (better, one)
    assert FITTED.log_odds(low) <= FITTED.log_odds(high) + 1e-9


FITTED = fit(*pairs())


def test_evidence_says_this_much_and_no_more():
    best, beyond = Evidence.of(0.3, 0.3, 0.5, 12.0), Evidence.of(-9.0, -9.0, 0.0, 9e9)
    assert FITTED.log_odds(best) == FITTED.log_odds(beyond)


def test_pairs_without_other_places_have_a_value_of_their_own():
    evidence, is_loop = pairs()
    some = evidence._replace(ambiguity_ratio=np.where(np.arange(len(is_loop)) % 5, evidence.ambiguity_ratio, np.nan))
    model = fit(some, is_loop)
    found = model.log_odds(some)
    assert np.isfinite(found).all() and np.mean((found > 0) == is_loop) > 0.9


def test_ambiguity_is_left_out():
    evidence, best = (Evidence.of(*ratios, 3.0, 2.0) for ratios in ((0.6, 0.7), (0.0, 0.0)))
    assert FITTED.log_odds_without_ambiguity(evidence) == FITTED.log_odds(best)
    np.testing.assert_allclose(FITTED.probability(evidence), 1 / (1 + np.exp(-FITTED.log_odds(evidence))))


def test_pairs_that_can_be_told_apart_give_finite_curves():
    evidence, is_loop = pairs(noise=0.01)
    model = fit(evidence, is_loop)
    assert all(max(curve.values) < 30 and curve.knots == KNOTS[name] for name, curve in model.curves.items())
    np.testing.assert_array_equal(model.probability(evidence) > 0.5, is_loop)


def test_recalibration_mends_probabilities_on_another_sensor():
    model = fit(*pairs())
    evidence, is_loop = pairs(seed=1, shift=0.15, noise=1.3)
    again = recalibrated(model, evidence, is_loop, made_with="own drive")
    other, truth = pairs(2000, seed=2, shift=0.15, noise=1.3)

    def surprise(of: LoopModel) -> float:
        probabilities = np.clip(of.probability(other), 1e-9, 1 - 1e-9)
        return float(-np.log(np.where(truth, probabilities, 1 - probabilities)).mean())

    assert surprise(again) < surprise(model)
    assert again.made_with == "own drive"
    order = np.argsort(model.log_odds(other))
    assert (np.diff(again.log_odds(other)[order]) > -1e-9).all()  # it stretches and shifts, and keeps the order


@pytest.mark.parametrize(
    "use", [lambda e, y: fit(e, y), lambda e, y: recalibrated(default_model(), e, y, made_with="")]
)
def test_one_kind_alone_cannot_be_fitted(use):
    evidence, is_loop = pairs(20)
    with pytest.raises(ValueError, match="expected loops and other pairs to fit, found 0 loops of 20"):
        use(evidence, is_loop & False)


def test_models_go_to_a_file_and_back(tmp_path):
    model = fit(*pairs(), made_with="here")
    path = tmp_path / "model.json"
    path.write_text(json.dumps(model.to_json()))
    assert default_model(path) == model
    values = model.to_json()

    def curve(**change):
        return {**values, "curves": {**values["curves"], "deviation": {**values["curves"]["deviation"], **change}}}

    broken = [curve(values=[np.nan] * 6), curve(values=[1.0]), curve(knots=[1.0] * 6)]
    broken += [{**values, "bias": "x"}, {**values, "bias": np.inf}, {**values, "curves": {"height": Curve((0,), (0,))}}]
    for wrong in ('{"bias": 1}', "[]", "no", "3", *map(json.dumps, broken)):
        path.write_text(wrong)
        with pytest.raises(ValueError, match=r"model\.json: expected"):
            default_model(path)


def test_the_shipped_model_tells_clear_pairs():
    model = default_model()
    loop, none = Evidence.of(0.3, 0.3, 0.5, 12.0), Evidence.of(1.0, 1.0, 4.0, 0.0)
    assert set(model.curves) == set(ALL) and model.probability(loop) > 0.99 and model.probability(none) < 0.01
