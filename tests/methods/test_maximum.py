import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.methods.learned.maximum import maximum


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
