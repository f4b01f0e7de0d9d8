"""The stem of convolutions: its shapes, what it is for, and that it leaves the properties of the model alone."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.backbones.stem import Stem, StemDecoder
from sglpr_jax.models.backbones.swin_config import SwinConfig
from sglpr_jax.models.config import HeadConfig
from sglpr_jax.models.presets import model_preset
from sglpr_jax.models.sglpr import describe, forward, segment

CONFIG = dataclasses.replace(
    model_preset("tiny"),
    field="circle",
    polar=(16, 32),
    backbone=SwinConfig(stem=(4, 8), embed_dim=8, depths=(1,), heads=(2,), window=4, drop_path=0.1),
    detail=6,
    head=HeadConfig(tap="tokens", channels=(8,), kernels=(3,), strides=(1,), clusters=4, cbam_reduction=4),
)
TRAINING_ONLY = {"decoder", "segmentation_head", "detail", "narrow"}
FAST_COMPILE = {"xla_backend_optimization_level": 0}

fast_describe = jax.jit(describe, compiler_options=FAST_COMPILE)
fast_forward = jax.jit(forward, static_argnames="segment", compiler_options=FAST_COMPILE)


@pytest.fixture(scope="module")
def params(random_params):
    return random_params(CONFIG)


def images(n: int) -> jax.Array:
    return jax.random.poisson(jax.random.key(1), 0.7, (n, 32, 32)).astype(jnp.float32)


def test_every_map_has_half_the_resolution_of_the_one_before_and_the_decoder_returns_to_the_first():
    image = jax.random.normal(jax.random.key(0), (2, 16, 32, 1))
    stem, decoder = Stem((4, 8, 12)), StemDecoder(patch=2)
    weights = stem.init(jax.random.key(0), image)
    maps = stem.apply(weights, image)
    assert [m.shape for m in maps] == [(2, 16, 32, 4), (2, 8, 16, 8), (2, 4, 8, 12)]
    tokens = jnp.ones((2, 2, 4, 10))
    pixels = decoder.apply(decoder.init(jax.random.key(1), tokens, maps), tokens, maps)
    assert pixels.shape == (2, 16, 32, 4)


def test_the_logits_near_a_cell_depend_most_on_its_counts(params):
    bev = images(1)
    change = jnp.abs(segment(params, bev) - segment(params, bev.at[0, 10, 20].add(9.0))).max(-1)[0]
    row, column = np.unravel_index(change.argmax(), change.shape)
    assert abs(row - 10) <= 2 and abs(column - 20) <= 2


def test_describe_has_neither_decoder_nor_segmentation_head(params):
    without = {name: weights for name, weights in params.weights.items() if name not in TRAINING_ONLY}
    assert set(params.weights) - set(without) == TRAINING_ONLY
    described = fast_describe(dataclasses.replace(params, weights=without), images(2))
    np.testing.assert_array_equal(described, fast_describe(params, images(2)))


def test_a_descriptor_does_not_depend_on_its_batch_and_vmap_agrees(params):
    bev = images(3)
    whole = fast_describe(params, bev)
    np.testing.assert_allclose(whole[1], fast_describe(params, bev[1]), atol=1e-5)
    one_by_one = jax.jit(jax.vmap(describe, in_axes=(None, 0)), compiler_options=FAST_COMPILE)(params, bev)
    np.testing.assert_allclose(whole, one_by_one, atol=1e-5)


def test_a_quarter_turn_of_the_image_shifts_the_tokens(params):
    """The borders are circular in the stem too."""
    straight, turned = (
        fast_forward(params, bev, segment=0).intermediates["patch_embed"]
        for bev in (images(1), jnp.rot90(images(1), axes=(1, 2)))
    )
    np.testing.assert_allclose(turned, jnp.roll(straight, straight.shape[2] // 4, axis=2), atol=1e-4)


def test_every_weight_is_trained(params):
    def loss(weights):
        outputs = forward(dataclasses.replace(params, weights=weights), images(2))
        return jnp.sum(outputs.descriptor * jnp.arange(256.0)[None]) + jnp.sum(outputs.logits**2)

    gradients = jax.jit(jax.grad(loss), compiler_options=FAST_COMPILE)(params.weights)
    for path, gradient in jax.tree_util.tree_leaves_with_path(gradients):
        assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0, jax.tree_util.keystr(path)


def test_a_patch_that_the_stem_does_not_divide_is_refused():
    with pytest.raises(
        ValueError, match=r"patch: expected a multiple of 8, the pixel of a stem with 4 widths, found 4"
    ):
        SwinConfig(stem=(8, 8, 8, 8))
