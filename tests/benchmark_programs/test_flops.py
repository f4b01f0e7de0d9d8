"""The counter of floating-point operations agrees with counts by hand and with a paper's."""

import importlib

import jax
import jax.numpy as jnp
import pytest

from sglpr_jax.models.swin import SwinBlock

pytestmark = pytest.mark.slow


def flops(function, *shapes: tuple[int, ...]) -> int:
    """What the counter of the benchmarks says of a function of arrays of these shapes."""
    count = importlib.import_module("benchmarks.speed.flops").count_flops
    return count(jax.jit(function).trace(*(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes)).jaxpr)


def test_products_are_counted_as_by_hand():
    product = 2 * 7 * 3 * 5 * 4
    assert flops(lambda a, b: jnp.einsum("bij,bjk->bik", a, b), (7, 3, 5), (7, 5, 4)) == product
    both = jax.grad(lambda ab: (ab[0] @ ab[1]).sum() + jnp.square(ab[0] @ ab[1]).sum())
    assert flops(lambda a, b: both((a, b)), (7, 3, 5), (7, 5, 4)) == product * 3 + product * 2
    assert flops(lambda a, b: jax.lax.scan(lambda x, _: (x @ b, None), a, length=6)[0], (3, 5), (5, 5)) == 6 * 150
    assert flops(lambda a, b: jax.lax.cond(a.sum() > 0, lambda: a @ b, lambda: a), (5, 5), (5, 5)) == 250
    assert flops(lambda a, b: (a @ b, a + 1)[1], (5, 5), (5, 5)) == 0  # nobody needs it
    with pytest.raises(ValueError, match="number of turns"):
        flops(lambda a, b: jax.lax.while_loop(lambda x: x.sum() > 0, lambda x: x @ b, a), (5, 5), (5, 5))


@pytest.mark.parametrize("groups", [1, 2])
def test_convolutions_and_their_gradients_are_counted_as_by_hand(groups):
    def convolve(image, kernel):
        dimensions = ("NHWC", "HWIO", "NHWC")
        return jax.lax.conv_general_dilated(
            image, kernel, (2, 2), "VALID", dimension_numbers=dimensions, feature_group_count=groups
        )

    image, kernel = (3, 8, 8, 4), (2, 2, 4 // groups, 6)
    forward = 2 * (3 * 4 * 4 * 6) * (2 * 2 * 4 // groups)
    assert flops(convolve, image, kernel) == forward
    gradient = jax.grad(lambda both: jnp.square(convolve(*both)).sum())
    assert flops(lambda *both: gradient(both), image, kernel) == 3 * forward


def test_a_swin_block_is_counted_as_in_its_paper():
    """4 h w C^2 + 2 M^2 h w C products for the attention (its equation 2), and 8 h w C^2 for the MLP.

    Not in the paper: the bias table is looked up by a product with one-hot rows, once for all images.
    """
    h, w, c, m, heads = 8, 16, 12, 4, 3
    block = SwinBlock(heads=heads, window=m, shifted=False)
    weights = jax.eval_shape(block.init, jax.random.key(0), jnp.zeros((1, h, w, c)))
    traced = jax.jit(block.apply).trace(weights, jax.ShapeDtypeStruct((5, h, w, c), jnp.float32))
    expected = 2 * 5 * (12 * h * w * c**2 + 2 * m**2 * h * w * c)
    bias = 2 * m**4 * (2 * m - 1) ** 2 * heads
    assert importlib.import_module("benchmarks.speed.flops").count_flops(traced.jaxpr) == expected + bias
