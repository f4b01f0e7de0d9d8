"""The convolution by half of the multiplications: it is XLA's, with its border, forward and backward."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.convolution import MANY_CHANNELS, MANY_PIXELS, as_product, convolve
from sglpr_jax.models.winograd import OF_COLUMNS, OF_KERNEL, OF_PRODUCTS, four_columns_at_once

STRIDES = [1, 2, 3]
ENOUGH = 11
"""Images of 7 x 8 pixels."""


def image_and_kernel(columns=10, channels=5, images=2):
    x, kernel = jax.random.split(jax.random.key(0))
    return jax.random.normal(x, (images, 7, columns, channels)), jax.random.normal(kernel, (3, 3, channels, 4)) / 3


def reference(x, kernel, stride):
    axes = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(x, kernel, (stride, 1), "VALID", dimension_numbers=axes, precision="highest")


def test_the_sums_are_a_correlation_of_six_numbers_with_three():
    for i, j in np.ndindex(6, 3):
        column, tap = np.eye(6)[i], np.eye(3)[j]
        found = OF_PRODUCTS @ ((OF_KERNEL @ tap) * (OF_COLUMNS @ column))
        np.testing.assert_allclose(found, np.correlate(column, tap), atol=1e-6)


@pytest.mark.parametrize("stride", STRIDES)
def test_it_is_xlas(stride):
    x, kernel = image_and_kernel()
    np.testing.assert_allclose(four_columns_at_once(x, kernel, stride), reference(x, kernel, stride), atol=2e-5)


@pytest.mark.parametrize("stride", STRIDES)
def test_the_gradient_is_xlas(stride):
    def gradients(form):
        return jax.jit(jax.grad(lambda x, kernel: (form(x, kernel, stride) ** 2).sum(), (0, 1)))(*image_and_kernel())

    for ours, expected in zip(gradients(four_columns_at_once), gradients(reference), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=1e-4)


def test_it_is_the_same_under_jit_and_vmap():
    x, kernel = image_and_kernel()
    expected = four_columns_at_once(x, kernel, 1)
    one_by_one = jax.jit(jax.vmap(lambda image: four_columns_at_once(image[None], kernel, 1)[0]))
    np.testing.assert_allclose(one_by_one(x), expected, atol=1e-5)


@pytest.mark.parametrize("circular", [True, False])
@pytest.mark.parametrize("strides", [(1, 1), (2, 1)])
def test_convolutions_of_many_channels_take_this_way(strides, circular):
    x, kernel = image_and_kernel(8, MANY_CHANNELS, ENOUGH)
    np.testing.assert_allclose(
        convolve(x, kernel, strides, circular), as_product(x, kernel, strides, circular), atol=2e-4
    )
    traced = str(jax.make_jaxpr(jax.grad(lambda x: convolve(x, kernel, strides, circular).sum()))(x))
    assert "conv_general_dilated" not in traced and traced.count("dot_general") >= 2 * len(OF_COLUMNS)


@pytest.mark.parametrize(
    "images, columns, channels, strides, dtype",
    [
        pytest.param(ENOUGH, 8, MANY_CHANNELS - 1, (1, 1), "float32", id="fewer channels"),
        pytest.param(ENOUGH - 1, 8, MANY_CHANNELS, (1, 1), "float32", id="fewer pixels"),
        pytest.param(ENOUGH, 10, MANY_CHANNELS, (1, 1), "float32", id="no multiple of four columns"),
        pytest.param(ENOUGH, 8, MANY_CHANNELS, (1, 2), "float32", id="stride along columns"),
        pytest.param(ENOUGH, 8, MANY_CHANNELS, (1, 1), "bfloat16", id="too few digits"),
    ],
)
def test_others_do_not(images, columns, channels, strides, dtype):
    assert (ENOUGH - 1) * 7 * 8 < MANY_PIXELS * MANY_CHANNELS < ENOUGH * 7 * 8
    x, kernel = (array.astype(dtype) for array in image_and_kernel(columns, channels, images))
    assert "conv_general_dilated" in str(jax.make_jaxpr(lambda x: convolve(x, kernel, strides, True))(x))


def test_on_another_machine_xla_chooses(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    x, kernel = image_and_kernel(8, MANY_CHANNELS, ENOUGH)
    assert "conv_general_dilated" in str(jax.make_jaxpr(lambda x: convolve(x, kernel, (1, 1), True))(jnp.asarray(x)))
