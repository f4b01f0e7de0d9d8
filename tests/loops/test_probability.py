"""The monotone model: it says what the pairs say, it is bounded, and its file holds all of it."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sglpr_jax.loops.probability import (
    KNOTS,
    RISING,
    SUM_OF_SUPPORT,
    TESTED,
    AdditiveModel,
    Evidence,
    LoopModel,
    default_model,
    fit,
    recalibrated,
)

DRAWN = {"ambiguity_ratio": (0.9, -0.4, 0.15), "along_m": (0.3, -0.2, 0.1), "deviation": (1.8, -1.0, 0.6)}
"""Mean of the pairs that are no loops, what a loop adds, and the standard deviation."""


def pairs(n: int = 600, *, seed: int = 0, noise: float = 1.0, shift: float = 0.0) -> tuple[Evidence, np.ndarray]:
    """Pairs of which a third are loops, with evidence that overlaps."""
    rng = np.random.default_rng(seed)
    is_loop = rng.random(n) < 1 / 3
    drawn = (DRAWN | {"surprise": (2.0, 1.0, 1.0)}).values()
    values = [mean + more * is_loop + noise * spread * rng.normal(size=n) for mean, more, spread in drawn]
    return Evidence(values[0] - shift, *values[1:]), is_loop


def model_of(evidence: Evidence, is_loop: np.ndarray, made_with: str = "") -> LoopModel:
    return LoopModel(fit(evidence._asdict(), is_loop), made_with)


def test_the_fit_finds_the_curve_that_the_pairs_were_drawn_from():
    """Log odds that bend once, which a straight line cannot follow."""
    rng, n = np.random.default_rng(0), 40_000
    values = {"ambiguity_ratio": rng.uniform(0, 1.2, n)}
    true = 4 * np.clip((0.8 - values["ambiguity_ratio"]) / 0.4, 0, 1) - 2
    is_loop = rng.random(n) < 1 / (1 + np.exp(-true))
    np.testing.assert_allclose(fit(values, is_loop)(values), true, atol=0.35)


def test_weights_are_as_good_as_pairs_that_stand_several_times():
    evidence, is_loop = pairs(200)
    values, often = evidence._asdict(), np.arange(200) % 3 + 1
    one = fit(values, is_loop, weights=often.astype(float))
    other = fit({name: np.repeat(column, often) for name, column in values.items()}, np.repeat(is_loop, often))
    np.testing.assert_allclose(one(values), other(values), atol=0.02)


@given(values=st.lists(st.floats(-1, 6), min_size=8, max_size=8), name=st.sampled_from(Evidence._fields))
def test_log_odds_never_fall_where_the_evidence_is_stronger(values, name):
    one, other = (Evidence.of(*half) for half in (values[:4], values[4:]))
    better = other._replace(**{field: getattr(one, field) for field in Evidence._fields if field != name})
    stronger = (
        getattr(better, name) >= getattr(one, name) if name in RISING else getattr(better, name) <= getattr(one, name)
    )
    low, high = (one, better) if stronger else (better, one)
    assert FITTED.log_odds(low) <= FITTED.log_odds(high) + 1e-9


FITTED = model_of(*pairs())


def test_neighbours_add_their_support_to_what_a_pair_says_alone():
    evidence = Evidence.of(0.7, 0.1, 3.0, 2.0)
    np.testing.assert_allclose(FITTED.tested_log_odds(evidence, np.array(2.5)), FITTED.log_odds(evidence) + 2.5)
    assert FITTED.tested is SUM_OF_SUPPORT and set(default_model().tested.curves) == set(TESTED)


def test_pairs_that_can_be_told_apart_give_finite_curves():
    evidence, is_loop = pairs(noise=0.01)
    model = model_of(evidence, is_loop)
    assert all(max(curve.values) < 30 and curve.knots == KNOTS[name] for name, curve in model.alone.curves.items())
    np.testing.assert_array_equal(model.probability(evidence) > 0.5, is_loop)


def test_recalibration_mends_probabilities_on_another_sensor():
    model = model_of(*pairs())
    evidence, is_loop = pairs(seed=1, shift=-0.15, noise=1.3)
    again = recalibrated(model, evidence, is_loop, made_with="own drive")
    other, truth = pairs(2000, seed=2, shift=-0.15, noise=1.3)

    def surprise(of: LoopModel) -> float:
        probabilities = np.clip(of.probability(other), 1e-9, 1 - 1e-9)
        return float(-np.log(np.where(truth, probabilities, 1 - probabilities)).mean())

    assert surprise(again) < surprise(model)
    assert again.made_with == "own drive"
    order = np.argsort(model.log_odds(other))
    assert (np.diff(again.log_odds(other)[order]) > -1e-9).all()  # it stretches and shifts, and keeps the order


def test_one_kind_alone_cannot_be_fitted():
    evidence, is_loop = pairs(20)
    with pytest.raises(ValueError, match="expected loops and other pairs to fit, found 0 loops of 20"):
        fit(evidence._asdict(), is_loop & False)


def test_models_go_to_a_file_and_back(tmp_path):
    model = model_of(*pairs(), made_with="here")
    path = tmp_path / "model.json"
    path.write_text(json.dumps(model.to_json()))
    assert default_model(path) == model
    values = model.to_json()

    def alone(**change):
        return {**values, "alone": {**values["alone"], **change}}

    def curve(**change):
        curves = values["alone"]["curves"]
        return alone(curves={**curves, "deviation": {**curves["deviation"], **change}})

    broken = [curve(values=[np.nan] * 6), curve(values=[1.0]), curve(knots=[1.0] * 6)]
    broken += [alone(bias="x"), alone(bias=np.inf), alone(curves={"height": {"knots": [0], "values": [0]}})]
    broken += [{**values, "tested": values["alone"]}]
    for wrong in ('{"bias": 1}', "[]", "no", "3", *map(json.dumps, broken)):
        path.write_text(wrong)
        with pytest.raises(ValueError, match=r"model\.json: expected"):
            default_model(path)


def test_the_shipped_model_tells_clear_pairs():
    model = default_model()
    loop, none = Evidence.of(0.3, 0.03, 0.5, 12.0), Evidence.of(1.0, 3.0, 4.0, 0.0)
    assert set(model.alone.curves) == set(Evidence._fields) and isinstance(model.alone, AdditiveModel)
    assert model.probability(loop) > 0.99 and model.probability(none) < 0.01
