"""The logistic model against scikit-learn, its file, and what recalibration does."""

import json

import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression

import sglpr_jax
from sglpr_jax.loops.probability import (
    ALL,
    OF_IMAGES,
    RIDGE,
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
    draw = [rng.normal(scale=noise * s, size=n) for s in (0.2, 0.2, 0.15, 0.2)]
    distance, margin = 1.2 - 0.5 * is_loop + draw[0], 0.1 + 0.3 * is_loop + draw[1]
    correlation, second = 0.2 + shift + 0.4 * is_loop + draw[2], 0.9 - 0.4 * is_loop + draw[3]
    return Evidence(distance, margin, correlation, second), is_loop


def test_the_fit_is_that_of_scikit_learn():
    evidence, is_loop = pairs()
    model = fit(evidence, is_loop)
    rows = np.stack([(value - value.mean()) / value.std() for value in evidence], axis=1)
    other = LogisticRegression(C=1 / RIDGE, tol=1e-10, max_iter=1000).fit(rows, is_loop)
    np.testing.assert_allclose(list(model.weights.values()), other.coef_[0], rtol=1e-3)
    np.testing.assert_allclose(model.probability(evidence), other.predict_proba(rows)[:, 1], atol=1e-3)


@pytest.mark.parametrize("names", [ALL, OF_IMAGES])
def test_probabilities_are_those_of_pairs_that_were_not_fitted(names):
    model = fit(*pairs(6000, noise=2.0), names=names)
    evidence, is_loop = pairs(6000, seed=1, noise=2.0)
    probabilities = model.probability(evidence)
    for low in np.arange(0, 1, 0.2):
        chosen = (probabilities >= low) & (probabilities < low + 0.2)
        assert abs(probabilities[chosen].mean() - is_loop[chosen].mean()) < 0.1


def test_a_margin_that_is_not_known_counts_as_the_mean():
    model = fit(*pairs())
    values = np.array([1.0, model.means["margin"], 0.4, 0.7])
    known, missing = Evidence(*values), Evidence(values[0], np.nan, *values[2:])
    assert model.probability(known) == pytest.approx(model.probability(missing))
    assert np.isfinite(fit(*with_missing_margins()).bias)


def with_missing_margins() -> tuple[Evidence, np.ndarray]:
    evidence, is_loop = pairs()
    return evidence._replace(margin=np.where(np.arange(len(is_loop)) % 5, evidence.margin, np.nan)), is_loop


def test_pairs_that_can_be_told_apart_give_finite_weights():
    evidence, is_loop = pairs(noise=0.01)
    model = fit(evidence, is_loop)
    assert all(abs(weight) < 10 for weight in model.weights.values())
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
    with pytest.raises(ValueError, match="expected loops and others to fit to, found 0 loops of 20"):
        use(evidence, is_loop & False)


def test_models_go_to_a_file_and_back(tmp_path):
    model = fit(*pairs(), made_with="here")
    path = tmp_path / "models.json"
    path.write_text(json.dumps({"": model.to_json()}))
    assert models(path) == {"": model}
    values = model.to_json()
    not_finite = [{**values, name: {**values[name], "margin": np.nan}} for name in ("weights", "means", "scales")]
    others = [json.dumps({"": value}) for value in ({**values, "bias": "x"}, {**values, "bias": np.inf}, *not_finite)]
    for wrong in ('{"": {"bias": 1}}', "[]", "no", '{"": 3}', *others):
        path.write_text(wrong)
        with pytest.raises(ValueError, match=r"models\.json: expected"):
            models(path)


def test_the_shipped_models_say_how_they_were_made_and_tell_clear_pairs():
    simulated = default_model(weights_hash(sglpr_jax.load("rings")))
    others = default_model("no such weights")
    assert set(simulated.weights) == set(ALL) and set(others.weights) == set(OF_IMAGES)
    loop, none = Evidence(0.6, 0.4, 0.8, 0.3), Evidence(1.2, 0.05, 0.2, 0.98)
    for model in (simulated, others):
        assert "benchmarks/fit_loops.py" in model.made_with
        assert model.probability(loop) > 0.99 and model.probability(none) < 0.01
