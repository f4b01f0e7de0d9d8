"""The whitening layer against numpy, fitted, applied, stored and taken off again."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.config import model_preset
from sglpr_jax.models.place_head import Whitening
from sglpr_jax.models.sglpr import describe, init
from sglpr_jax.models.weights_file import load, save
from sglpr_jax.models.whitening import fit_whitening, unwhitened, whitened

RNG = np.random.default_rng(0)
CLOUD = RNG.normal(size=(500, 6)) * [3, 1, 0.5, 0.3, 0.2, 0.1] @ RNG.normal(size=(6, 6)) + RNG.normal(size=6)
BEV = jnp.asarray(RNG.poisson(0.7, (4, 32, 32)), jnp.float32)


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0])
def test_the_spread_along_every_component_is_its_own_to_the_power_left(power):
    spread = np.linalg.svd(CLOUD, compute_uv=False)[::-1] / len(CLOUD) ** 0.5
    expected = spread * (spread / spread.max()) ** -power
    mapped = CLOUD @ fit_whitening(CLOUD, power=power)
    np.testing.assert_allclose(mapped.T @ mapped / len(CLOUD), np.diag(expected**2), atol=1e-3)


def test_distances_are_those_of_numpy():
    kernel, bias = fit_whitening(CLOUD, power=0.5), RNG.normal(size=6).astype(np.float32)
    vectors = CLOUD / np.linalg.norm(CLOUD, axis=1, keepdims=True)
    found = Whitening().apply({"params": {"kernel": kernel, "bias": bias}}, jnp.asarray(vectors, jnp.float32))
    expected = vectors @ kernel.astype(np.float64) + bias
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-5)


def test_a_direction_without_spread_stays_finite():
    flat = CLOUD * [1, 1, 1, 1, 1, 0]
    assert np.isfinite(fit_whitening(flat, power=1.0)).all()


@pytest.mark.parametrize("n", [1, 20])
def test_equal_descriptors_are_refused(n):
    with pytest.raises(ValueError, match=f"found {n} equal descriptors"):
        fit_whitening(np.ones((n, 6)))


@pytest.mark.slow
def test_a_fresh_layer_is_the_identity():
    config = model_preset("tiny")
    layered = dataclasses.replace(config, head=dataclasses.replace(config.head, whiten=True))
    key = jax.random.key(0)
    plain, with_layer = init(key, config=config), init(key, config=layered)
    np.testing.assert_array_equal(with_layer.weights["place_head"]["whiten"]["kernel"], np.eye(256))
    np.testing.assert_allclose(describe(unwhitened(with_layer), BEV), describe(with_layer, BEV), atol=1e-6)
    assert unwhitened(plain) is plain


@pytest.mark.slow
def test_fitted_weights_describe_are_stored_and_lose_the_layer_again(random_params, tmp_path):
    params = random_params(model_preset("tiny"))
    before = np.asarray(describe(params, BEV))
    samples = before[:1] + RNG.normal(scale=0.1, size=(600, 256)).astype(np.float32)
    fitted = whitened(params, samples)
    expected = before @ fit_whitening(samples)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(describe(fitted, BEV), expected, atol=1e-4)
    np.testing.assert_allclose(describe(load(save(fitted, tmp_path / "weights")), BEV), expected, atol=1e-4)
    chex.assert_trees_all_equal(unwhitened(fitted), params)
    with pytest.raises(ValueError, match="without a whitening layer"):
        whitened(fitted, samples)
