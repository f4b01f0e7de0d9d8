"""The monotone model: it says what the pairs say, it is bounded, and its file holds all of it."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sglpr_jax
from sglpr_jax.loops.probability import (
    ALL,
    KNOTS,
    OF_IMAGES,
    RISING,
    Curve,
    Evidence,
    LoopModel,
    default_model,
    fit,
    models,
    recalibrated,
)
from sglpr_jax.models.weights import weights_hash


def pairs(n: int = 600, *, seed: int = 0, noise: float = 1.0, shift: float = 0.0) -> tuple[Evidence, np.ndarray]:
    """Pairs of which a third are loops, with evidence that overlaps."""
    rng = np.random.default_rng(seed)
    is_loop = rng.random(n) < 1 / 3
    draw = [rng.normal(scale=noise * s, size=n) for s in (0.2, 0.2, 0.15, 0.2, 0.15, 200.0)]
    distance, share = 1.2 - 0.5 * is_loop + draw[0], 1.0 - 0.4 * is_loop + draw[1]
    correlation, second = 0.2 + shift + 0.4 * is_loop + draw[2], 0.9 - 0.4 * is_loop + draw[3]
    rival, cells = 0.9 - 0.4 * is_loop + draw[4], 600 + 300 * is_loop + draw[5]
    return Evidence(distance, share, correlation, second, rival, cells), is_loop


@pytest.mark.parametrize("names", [ALL, OF_IMAGES])
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
    evidence = Evidence(*[values if name == "rival" else np.full(n, 0.5) for name in ALL])
    model = fit(evidence, is_loop, names=("rival",))
    np.testing.assert_allclose(model.log_odds(evidence), true, atol=0.35)


def test_weights_are_as_good_as_pairs_that_stand_several_times():
    evidence, is_loop = pairs(200)
    often = np.arange(200) % 3 + 1
    again = Evidence(*(np.repeat(values, often) for values in evidence))
    one = fit(evidence, is_loop, weights=often.astype(float))
    other = fit(again, np.repeat(is_loop, often))
    np.testing.assert_allclose(one.log_odds(evidence), other.log_odds(evidence), atol=0.02)


@given(values=st.lists(st.floats(-1, 3), min_size=12, max_size=12), name=st.sampled_from(ALL))
def test_log_odds_never_fall_where_the_evidence_is_stronger(values, name):
    one, other = (Evidence(*np.array(half)) for half in (values[:6], values[6:]))
    better = other._replace(**{field: getattr(one, field) for field in ALL if field != name})
    stronger = (
        getattr(better, name) >= getattr(one, name) if name in RISING else getattr(better, name) <= getattr(one, name)
    )
    low, high = (one, better) if stronger else (better, one)
    assert FITTED.log_odds(low) <= FITTED.log_odds(high) + 1e-9


FITTED = fit(*pairs())


def test_evidence_says_this_much_and_no_more():
    best, beyond = Evidence(0.2, 0.3, 0.8, 0.3, 0.3, 1600.0), Evidence(-9.0, -9.0, 9.0, -9.0, -9.0, 9e9)
    assert FITTED.log_odds(best) == FITTED.log_odds(beyond)


def test_no_rivals_count_as_the_worst():
    missing, worst = (Evidence(0.5, rival, 0.7, 0.4, rival, 900.0) for rival in (np.nan, 9.0))
    assert FITTED.log_odds(missing) == FITTED.log_odds(worst) < FITTED.but_for_repetition(missing)
    evidence, is_loop = pairs()
    some = np.where(np.arange(len(is_loop)) % 5, evidence.rival, np.nan)
    assert np.isfinite(fit(evidence._replace(rival=some), is_loop).bias)


def test_pairs_that_can_be_told_apart_give_finite_curves():
    evidence, is_loop = pairs(noise=0.01)
    model = fit(evidence, is_loop)
    assert all(max(curve.values) < 30 and curve.knots == KNOTS[name] for name, curve in model.curves.items())
    np.testing.assert_array_equal(model.probability(evidence) > 0.5, is_loop)


def test_recalibration_mends_probabilities_on_another_sensor():
    model = fit(*pairs())
    evidence, is_loop = pairs(seed=1, shift=0.2, noise=1.3)
    again = recalibrated(model, evidence, is_loop, made_with="own drive")
    other, truth = pairs(2000, seed=2, shift=0.2, noise=1.3)

    def surprise(of: LoopModel) -> float:
        probabilities = np.clip(of.probability(other), 1e-9, 1 - 1e-9)
        return float(-np.log(np.where(truth, probabilities, 1 - probabilities)).mean())

    assert surprise(again) < surprise(model)
    assert again.made_with == "own drive"
    order = np.argsort(model.log_odds(other))
    assert (np.diff(again.log_odds(other)[order]) > -1e-9).all()  # it stretches and shifts, and keeps the order


@pytest.mark.parametrize(
    "use", [lambda e, y: fit(e, y), lambda e, y: recalibrated(default_model(""), e, y, made_with="")]
)
def test_one_kind_alone_cannot_be_fitted(use):
    evidence, is_loop = pairs(20)
    with pytest.raises(ValueError, match="expected loops and other pairs to fit, found 0 loops of 20"):
        use(evidence, is_loop & False)


def test_models_go_to_a_file_and_back(tmp_path):
    model = fit(*pairs(), made_with="here")
    path = tmp_path / "models.json"
    path.write_text(json.dumps({"": model.to_json()}))
    assert models(path) == {"": model}
    values = model.to_json()

    def curve(**change):
        return {**values, "curves": {**values["curves"], "rival": {**values["curves"]["rival"], **change}}}

    broken = [curve(values=[np.nan] * 8), curve(values=[1.0]), curve(knots=[1.0] * 8), curve(more=3)]
    broken += [{**values, "bias": "x"}, {**values, "bias": np.inf}, {**values, "curves": {"height": Curve((0,), (0,))}}]
    for wrong in ('{"": {"bias": 1}}', "[]", "no", '{"": 3}', *(json.dumps({"": value}) for value in broken)):
        path.write_text(wrong)
        with pytest.raises(ValueError, match=r"models\.json: expected"):
            models(path)


def test_the_shipped_models_say_how_they_were_made_and_tell_clear_pairs():
    shipped, others = default_model(weights_hash(sglpr_jax.load("sglpr"))), default_model("no such weights")
    assert set(shipped.curves) == set(ALL) and set(others.curves) == set(OF_IMAGES)
    loop, none, repeats = (
        Evidence(0.3, 0.3, 0.9, 0.3, 0.25, 1000.0),
        Evidence(1.2, 1.0, 0.2, 0.98, 1.2, 1000.0),
        Evidence(0.01, 1.0, 0.99, 0.97, 1.0, 300.0),
    )
    for model in (shipped, others):
        assert "benchmarks/quality/fit_loops.py" in model.made_with
        assert model.probability(loop) > 0.99 and model.probability(none) < 0.01
        assert model.probability(repeats) < 0.1
