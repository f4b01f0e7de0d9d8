"""The place head: shapes for every candidate, unit descriptors, and convolutions that border maps as PyTorch does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.config import HeadConfig
from sglpr_jax.models.place_head import PlaceHead


def head(kernels, strides):
    return PlaceHead(HeadConfig(channels=(8, 12, 16), kernels=kernels, strides=strides, clusters=4, descriptor_size=32))


@pytest.mark.parametrize(
    ("kernels", "strides", "sizes"),
    [((3, 3, 3), (2, 2, 2), [16, 8, 4]), ((4, 3, 3), (4, 2, 2), [8, 4, 2]), ((2, 2, 2), (2, 2, 2), [16, 8, 4])],
    ids=["A: 3/2 3/2 3/2", "B: 4/4 3/2 3/2", "C: 2/2 2/2 2/2"],
)
def test_the_map_shrinks_by_each_stride(kernels, strides, sizes):
    run = head(kernels, strides).init_with_output
    (descriptors, seen), _ = jax.eval_shape(run, jax.random.key(0), jnp.zeros((3, 32, 32, 6)))
    assert descriptors.shape == (3, 32)
    assert [seen[f"head_convolution{i}"].shape[1] for i in range(3)] == sizes


@pytest.mark.slow
def test_descriptors_have_length_one_and_do_not_depend_on_their_batch(random_variables):
    module = head((4, 3, 3), (4, 2, 2))
    features = jnp.asarray(np.random.default_rng(0).normal(size=(3, 32, 32, 6)), jnp.float32)
    variables = random_variables(module, features)

    def describe(x):
        return module.apply(variables, x)[0]

    descriptors = describe(features)
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(jax.jit(describe)(features[1:2]), descriptors[1:2], atol=2e-6)
    one_by_one = jax.jit(jax.vmap(describe))(features[:, None])[:, 0]
    np.testing.assert_allclose(one_by_one, descriptors, atol=2e-6)


def test_a_stride_two_convolution_is_centred_on_every_second_pixel(random_variables):
    """Flax's SAME would start at pixel 1 on even sizes; PyTorch's padding of 1 starts at pixel 0."""
    module = head((3, 3, 3), (2, 2, 2))
    features = jnp.asarray(np.random.default_rng(0).normal(size=(1, 8, 8, 6)), jnp.float32)
    variables = random_variables(module, features)
    _, seen = jax.jit(module.apply)(variables, features)
    layer, norm = (variables["params"][name] for name in ("convolution_0", "norm_0"))
    bordered = np.pad(np.asarray(seen["cbam"])[0], ((1, 1), (1, 1), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(bordered, (3, 3), (0, 1))[::2, ::2]
    expected = np.einsum("ijcyx,yxco->ijo", windows, layer["kernel"]) + layer["bias"]
    expected = (expected - expected.mean(-1, keepdims=True)) / np.sqrt(expected.var(-1, keepdims=True) + 1e-5)
    expected = expected * norm["scale"] + norm["bias"]
    np.testing.assert_allclose(seen["head_convolution0"][0], np.maximum(expected, 0), atol=2e-5)


@pytest.mark.slow
def test_an_empty_map_has_finite_gradients(random_variables):
    module, features = head((4, 3, 3), (4, 2, 2)), jnp.zeros((2, 32, 32, 6))
    variables = random_variables(module, features)
    loss = jax.jit(jax.grad(lambda v, x: module.apply(v, x)[0].sum(), (0, 1)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(loss(variables, features)))
