"""The convolution by a quarter of the multiplications: it is XLA's, with its border, forward and backward."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.convolution import MANY_CHANNELS, MANY_PIXELS, as_product, convolve
from sglpr_jax.models.winograd import OF_KERNEL, OF_PIXELS, OF_PRODUCTS, winograd

ROWS_AND_STRIDES = [(4, 1), (8, 1), (7, 1), (8, 2), (7, 2), (7, 3)]
"""Eight rows and four go along both axes, the others along the columns alone."""
ENOUGH = 48
"""Images of 4 x 8 pixels."""


def image_and_kernel(rows=8, columns=8, channels=5, features=4, images=2):
    x, kernel = jax.random.split(jax.random.key(0))
    x = jax.random.normal(x, (images, rows, columns, channels))
    return x, jax.random.normal(kernel, (3, 3, channels, features)) / 3


def reference(x, kernel, stride, circular):
    x = jnp.pad(x, ((0, 0), (0, 0), (1, 1), (0, 0)), mode="wrap" if circular else "constant")
    axes, border = ("NHWC", "HWIO", "NHWC"), ((1, 1), (0, 0))
    return jax.lax.conv_general_dilated(x, kernel, (stride, 1), border, dimension_numbers=axes, precision="highest")


def test_the_sums_are_a_correlation_of_six_numbers_with_three():
    for i, j in np.ndindex(6, 3):
        column, tap = np.eye(6)[i], np.eye(3)[j]
        found = OF_PRODUCTS @ ((OF_KERNEL @ tap) * (OF_PIXELS @ column))
        np.testing.assert_allclose(found, np.correlate(column, tap), atol=1e-6)


@pytest.mark.parametrize("circular", [True, False])
@pytest.mark.parametrize("rows, stride", ROWS_AND_STRIDES)
def test_it_is_xlas(rows, stride, circular):
    x, kernel = image_and_kernel(rows)
    expected = reference(x, kernel, stride, circular)
    np.testing.assert_allclose(winograd(x, kernel, stride, circular), expected, atol=1e-4)


@pytest.mark.parametrize("circular", [True, False])
@pytest.mark.parametrize("rows, stride", ROWS_AND_STRIDES)
def test_the_gradient_is_xlas(rows, stride, circular):
    def gradients(form):
        loss = jax.grad(lambda x, kernel: (form(x, kernel, stride, circular) ** 2).sum(), (0, 1))
        return jax.jit(loss)(*image_and_kernel(rows))

    for ours, expected in zip(gradients(winograd), gradients(reference), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("rows", [8, 7])
def test_it_is_the_same_under_jit_and_vmap(rows):
    x, kernel = image_and_kernel(rows)
    expected = winograd(x, kernel, 1, True)
    one_by_one = jax.jit(jax.vmap(lambda image: winograd(image[None], kernel, 1, True)[0]))
    np.testing.assert_allclose(one_by_one(x), expected, atol=5e-5)


@pytest.mark.parametrize("circular", [True, False])
@pytest.mark.parametrize("rows, stride, sums", [(4, 1, len(OF_PIXELS) ** 2), (8, 2, len(OF_PIXELS))])
def test_convolutions_of_many_channels_take_this_way(rows, stride, sums, circular):
    x, kernel = image_and_kernel(rows, 8, MANY_CHANNELS, MANY_CHANNELS, ENOUGH)
    strides = (stride, 1)
    expected = as_product(x, kernel, strides, circular)
    np.testing.assert_allclose(convolve(x, kernel, strides, circular), expected, atol=5e-4)
    traced = str(jax.make_jaxpr(jax.grad(lambda x: convolve(x, kernel, strides, circular).sum()))(x))
    assert "conv_general_dilated" not in traced and traced.count("dot_general") >= 2 * sums


@pytest.mark.parametrize(
    "images, columns, channels, features, strides, dtype",
    [
        pytest.param(ENOUGH, 8, MANY_CHANNELS - 1, MANY_CHANNELS, (1, 1), "float32", id="fewer channels"),
        pytest.param(ENOUGH, 8, MANY_CHANNELS, MANY_CHANNELS - 1, (1, 1), "float32", id="fewer of the result"),
        pytest.param(ENOUGH - 1, 8, MANY_CHANNELS, MANY_CHANNELS, (1, 1), "float32", id="fewer pixels"),
        pytest.param(ENOUGH, 10, MANY_CHANNELS, MANY_CHANNELS, (1, 1), "float32", id="no multiple of four columns"),
        pytest.param(ENOUGH, 8, MANY_CHANNELS, MANY_CHANNELS, (1, 2), "float32", id="stride along columns"),
        pytest.param(ENOUGH, 8, MANY_CHANNELS, MANY_CHANNELS, (1, 1), "bfloat16", id="too few digits"),
    ],
)
def test_others_do_not(images, columns, channels, features, strides, dtype):
    assert (ENOUGH - 1) * 4 * 8 < MANY_PIXELS <= ENOUGH * 4 * 8
    x, kernel = (array.astype(dtype) for array in image_and_kernel(4, columns, channels, features, images))
    assert "conv_general_dilated" in str(jax.make_jaxpr(lambda x: convolve(x, kernel, strides, True))(x))


def test_on_another_machine_xla_chooses(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    x, kernel = image_and_kernel(4, 8, MANY_CHANNELS, MANY_CHANNELS, ENOUGH)
    assert "conv_general_dilated" in str(jax.make_jaxpr(lambda x: convolve(x, kernel, (1, 1), True))(jnp.asarray(x)))
