"""The average of weights against numpy."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from sglpr_jax.models.average import average
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import init
from sglpr_jax.models.weights import by_name, for_places
from sglpr_jax.models.whitening import whitened


@functools.cache
def fresh(seed: int) -> Params:
    return init(jax.random.key(seed), preset="tiny")


@pytest.mark.slow
def test_every_parameter_is_the_weighted_mean():
    models = [fresh(seed) for seed in range(3)]
    found = by_name(average(models, shares=[4.0, 3.0, 1.0]).weights)
    names = [by_name(model.weights) for model in models]
    for name, value in found.items():
        expected = np.average([np.asarray(each[name], np.float64) for each in names], axis=0, weights=[4, 3, 1])
        np.testing.assert_allclose(value, expected, rtol=1e-5, atol=1e-7)
    assert found.keys() == names[0].keys() and any(np.ptp(np.asarray(value)) > 0 for value in found.values())


def test_without_shares_all_count_alike_and_half_precision_is_read_as_float32():
    one, other = fresh(0), fresh(1)
    half = dataclasses.replace(other, weights=jax.tree.map(lambda leaf: leaf.astype(np.float16), other.weights))
    found = by_name(average([one, half]).weights)
    for name, value in found.items():
        assert value.dtype == np.float32
        expected = (by_name(one.weights)[name] + np.float32(by_name(half.weights)[name])) / 2
        np.testing.assert_allclose(value, expected, rtol=1e-5, atol=1e-7)


def test_whitening_layers_are_left_out():
    plain = fresh(0)
    descriptors = np.random.default_rng(0).normal(size=(300, 256)).astype(np.float32)
    found = average([whitened(plain, descriptors), plain])
    assert found.config == plain.config
    for name, value in by_name(found.weights).items():
        np.testing.assert_allclose(value, by_name(plain.weights)[name], rtol=1e-6)


@pytest.mark.parametrize("shares", [[1.0], [1.0, 2.0, 3.0], [2.0, -1.0], [0.0, 0.0]])
def test_shares_that_weigh_nothing_are_refused(shares):
    with pytest.raises(ValueError, match="expected 2 shares of 0 or more, not all 0, found"):
        average([fresh(0), fresh(1)], shares=shares)


def test_no_models_have_no_mean():
    with pytest.raises(ValueError, match="found \\[\\]"):
        average([])


def test_models_that_differ_are_refused_by_the_name_of_what_does():
    one = fresh(0)
    with pytest.raises(ValueError, match="found categories 20 and 0"):
        average([one, for_places(one)])
    head = dataclasses.replace(model_preset("tiny").head, clusters=7)
    with pytest.raises(ValueError, match=r"found head\.clusters \d+ and 7"):
        average([one, init(jax.random.key(0), config=dataclasses.replace(model_preset("tiny"), head=head))])
