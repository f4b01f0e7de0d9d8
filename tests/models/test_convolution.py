"""The convolution: forward and backward it is XLA's, and its gradient is made of products alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.convolution import FEW_INPUTS, convolve, convolve_as_product

CASES = [
    pytest.param(3, (1, 1), True, id="around"),
    pytest.param(3, (2, 1), True, id="around, stride along rows"),
    pytest.param(3, (1, 1), False, id="flat"),
    pytest.param(4, (4, 4), False, id="side by side"),
    pytest.param(4, (1, 1), False, id="even"),
    pytest.param(5, (1, 1), True, id="five"),
]
SHAPES = [(2, 8, 8, 1), (2, 8, 8, 6)]
"""Few channels and many: these go other ways."""


def reference(x, kernel, strides, circular):
    """XLA's on an image whose border is written out."""
    size = len(kernel)
    border = 0 if strides == (size, size) else size // 2
    x = jnp.pad(x, ((0, 0), (0, 0), (border, border), (0, 0)), mode="wrap" if circular else "constant")
    x = jnp.pad(x, ((0, 0), (border, border), (0, 0), (0, 0)))
    axes = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(x, kernel, strides, "VALID", dimension_numbers=axes, precision="highest")


def image_and_kernel(shape, size):
    x, kernel = jax.random.split(jax.random.key(0))
    return jax.random.normal(x, shape), jax.random.normal(kernel, (size, size, shape[-1], 4)) / size


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("size, strides, circular", CASES)
def test_both_forms_and_the_gradient_are_xlas(size, strides, circular, shape):
    def with_gradient(form, *inputs):
        found, backward = jax.vjp(lambda x, kernel: form(x, kernel, strides, circular), *inputs)
        return found, *backward(2 * found)

    @jax.jit
    def every_form(*inputs):
        product = convolve_as_product(*inputs, strides, circular)
        return product, with_gradient(convolve, *inputs), with_gradient(reference, *inputs)

    product, (ours, *gradients), (expected, *of_xla) = every_form(*image_and_kernel(shape, size))
    for found in (product, ours):
        np.testing.assert_allclose(found, expected, atol=2e-5)
    for found, other in zip(gradients, of_xla, strict=True):
        np.testing.assert_allclose(found, other, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("size, strides, circular", CASES)
def test_no_convolution_runs_backward(size, strides, circular):
    def loss(x, kernel):
        return convolve(x, kernel, strides, circular).sum()

    few, many = (str(jax.make_jaxpr(jax.grad(loss, (0, 1)))(*image_and_kernel(shape, size))) for shape in SHAPES)
    assert many.count("conv_general_dilated") == 1  # the one forward
    assert few.count("conv_general_dilated") == (size * SHAPES[0][-1] > FEW_INPUTS)
