"""Layers of the learned methods: NetVLAD and its clusters at the start, and the maximum with its derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from sglpr_jax.methods.learned.layers import FEATURES, LOCAL, NetVLAD, maximum, with_clusters
from sglpr_jax.models.layers import l2_normalize

from . import image_reference as reference

DIRECTIONS = l2_normalize(2 + jax.random.normal(jax.random.key(0), (8, 16)))


class Points(nn.Module):
    """Local features near 8 directions, which differ little and are chosen by the input, and 8 clusters."""

    @nn.compact
    def __call__(self, inputs, *, train):
        local = l2_normalize(DIRECTIONS[inputs] + 0.01 * jnp.cos(jnp.arange(16.0)[None, None] * inputs[..., None]))
        self.sow(LOCAL, FEATURES, local)
        return NetVLAD(8)(local)


@pytest.fixture(scope="module")
def clustered():
    inputs = np.random.default_rng(0).integers(0, 8, (20, 30))
    variables = Points().init(jax.random.key(0), inputs[:1], train=False)
    return inputs, variables, with_clusters(Points(), {"params": variables["params"]}, inputs)


def test_centres_are_those_of_the_features(clustered):
    centres = clustered[2]["params"]["NetVLAD_0"]["centres"]
    nearest = np.linalg.norm(DIRECTIONS[:, None] - centres[None], axis=-1)
    assert nearest.min(1).max() < 0.1
    assert sorted(nearest.argmin(1)) == list(range(8))


def test_the_second_nearest_cluster_gets_a_hundredth(clustered):
    inputs, _, found = clustered
    _, local = Points().apply(found, inputs, train=False, mutable=[LOCAL])
    logits = np.sort(local[LOCAL][FEATURES][0] @ found["params"]["NetVLAD_0"]["assignment"], axis=-1)
    assert np.mean(logits[..., -1] - logits[..., -2]) == pytest.approx(np.log(100), rel=0.05)


def test_descriptors_are_farther_apart(clustered):
    inputs, before, after = clustered

    def apart(variables):
        found = Points().apply({"params": variables["params"]}, inputs, train=False)
        return np.linalg.norm(found[:, None] - found[None], axis=-1).mean()

    assert apart(after) > 1.5 * apart(before)


def test_netvlad():
    x = jax.random.normal(jax.random.key(0), (2, 30, 5))
    layer = NetVLAD(7)
    variables = layer.init(jax.random.key(0), x)
    params = jax.tree.map(np.asarray, variables["params"])
    expected = np.stack([reference.netvlad(one, params) for one in np.asarray(x)])
    np.testing.assert_allclose(layer.apply(variables, x), expected, atol=1e-5)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_maximum_and_its_derivative_are_those_of_numpy(axis):
    x = np.random.default_rng(0).normal(size=(3, 4, 5)).astype(np.float32)
    np.testing.assert_array_equal(maximum(jnp.asarray(x), axis), x.max(axis))
    slope = jax.grad(lambda x: jnp.square(maximum(x, axis)).sum())(jnp.asarray(x))
    highest = x == x.max(axis, keepdims=True)
    np.testing.assert_allclose(slope, 2 * x * highest, rtol=1e-6)


def test_equal_values_have_one_winner():
    slope = jax.grad(lambda x: maximum(x, 0).sum())(jnp.ones((4, 2)))
    np.testing.assert_array_equal(slope.sum(0), 1)
    assert set(np.asarray(slope).ravel().tolist()) == {0.0, 1.0}
