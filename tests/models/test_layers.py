"""Layer norm, product, maximum and unit length, whose derivatives are written out, against those of JAX itself."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.layers import EPSILON, l2_normalize, layer_norm, maximum, product

RNG = np.random.default_rng(0)
SCALE, BIAS = (jnp.asarray(RNG.normal(size=6), jnp.float32) for _ in range(2))
ROWS = jnp.asarray(RNG.normal(size=(4, 5, 6)) * 3 + 1, jnp.float32)
WEIGHTS = jnp.asarray(RNG.normal(size=(4, 5, 6)), jnp.float32)


def plain(x, scale, bias):
    centred = x - x.mean(-1, keepdims=True)
    return centred / jnp.sqrt((centred**2).mean(-1, keepdims=True) + EPSILON) * scale[None] + bias[None]


def assert_close(found, expected):
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=2e-5, atol=2e-5), found, expected)


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit])
def test_values_and_gradients_are_those_of_the_plain_formula(wrap):
    def loss(norm, x, scale, bias):
        return jnp.sum(norm(x, scale, bias) ** 3 * WEIGHTS[0])

    assert_close(wrap(layer_norm)(ROWS[0], SCALE, BIAS), plain(ROWS[0], SCALE, BIAS))
    found, expected = (wrap(jax.grad(functools.partial(loss, norm), (0, 1, 2))) for norm in (layer_norm, plain))
    assert_close(found(ROWS[0], SCALE, BIAS), expected(ROWS[0], SCALE, BIAS))


SIZES = [pytest.param(20, 7, 3, id="tall"), pytest.param(20, 3, 7, id="wide"), pytest.param(4, 7, 3, id="few rows")]
"""Rows, and rows and columns of the matrix: the gradients of these are computed in different orders."""


def rows_and_matrix(n, c, f):
    rng = np.random.default_rng(0)
    return tuple(jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((n, c), (c, f)))


@pytest.mark.parametrize("n, c, f", SIZES)
def test_the_product_and_its_gradients_are_the_plain_ones(n, c, f):
    x, matrix = rows_and_matrix(n, c, f)

    def of(form, matrix):
        return jax.value_and_grad(lambda x, m: jnp.sum(form(x, m) ** 2), (0, 1))(x, matrix)

    for matrices, wrap in ((matrix, jax.jit), (jnp.stack([matrix, 2 * matrix]), jax.vmap)):
        found, expected = (wrap(functools.partial(of, form))(matrices) for form in (product, jnp.matmul))
        assert_close(found, expected)


@pytest.mark.parametrize("axes", [(0,), (1, 2)])
def test_the_maximum_and_its_gradient_are_those_of_jax_and_survive_rounding(axes):
    """An entry that rounding keeps from being equal to the maximum still has its gradient; ties share it."""
    for derivative in (jax.grad, jax.jacfwd):
        found = derivative(lambda x: jnp.square(maximum(x, axes)).sum())(ROWS)
        np.testing.assert_allclose(found, derivative(lambda x: jnp.square(x.max(axes)).sum())(ROWS), rtol=1e-6)
    tied = jnp.asarray([2.0, 1.0, np.nextafter(np.float32(2), np.float32(0)), 2.0], jnp.float32)
    np.testing.assert_allclose(jax.grad(lambda x: maximum(x, (0,)))(tied), [1 / 3, 0, 1 / 3, 1 / 3], rtol=1e-6)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-8, 1e8])
def test_l2_normalize_gives_unit_vectors_or_zero_and_finite_gradients(scale):
    x = scale * jnp.asarray([[3.0, 4.0]])
    expected = [[0.6, 0.8]] if scale > 1e-12 else [[0.0, 0.0]]
    np.testing.assert_allclose(l2_normalize(x), expected, atol=1e-6)
    assert np.isfinite(jax.grad(lambda x: l2_normalize(x)[0, 0])(x)).all()
