"""The preset sglpr: shapes, and that a rotation by whole windows shifts its features and leaves its descriptor."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

from sglpr_jax.models import sglpr
from sglpr_jax.models.config import CircularConfig, HeadConfig, ModelConfig, SglprConfig, model_preset
from sglpr_jax.models.place_head import PlaceHead
from sglpr_jax.models.sglpr import forward
from sglpr_jax.models.swin_on_circular import CircularSwin
from sglpr_jax.models.weights import weight_shapes
from sglpr_jax.models.weights_file import load, save
from sglpr_jax.retrieval.image_maps import heat_maps

STEM = CircularConfig(widths=(4, 6), strides=(2, 1), means=(1, 1))
BACKBONE = SglprConfig(stem=STEM, embed_dim=8, depths=(2, 2), heads=(1, 2), window=2)
HEAD = HeadConfig(
    tap="tokens", channels=(8, 8), kernels=(3, 3), strides=(2, 1), means=(1, 2), cbam_reduction=4, clusters=4
)
CONFIG = dataclasses.replace(model_preset("tiny"), field="circle", polar=(16, 32), backbone=BACKBONE, head=HEAD)
BEV = jax.random.poisson(jax.random.key(1), 0.7, (3, 32, 32)).astype(jnp.float32)
POLAR = jax.random.normal(jax.random.key(0), (2, 16, 32, 2))

describe, segment = jax.jit(sglpr.describe), jax.jit(sglpr.segment)


@pytest.fixture(scope="module")
def params(random_params):
    return random_params(CONFIG)


def test_maps_and_tokens_have_the_shapes_configured(random_variables):
    net = CircularSwin(BACKBONE)
    tokens, maps, seen = jax.jit(net.apply)(random_variables(net, POLAR), POLAR)
    assert tokens.shape == (2, 4, 16, 8)
    assert [m.shape for m in maps] == [(2, 8, 16, 2), (2, 4, 16, 4)]
    assert seen["circular_block1"].shape == (2, 4, 16, 6)
    assert seen["enc1_out"].shape == (2, 2, 8, 16)


def test_a_turn_by_windows_of_the_coarsest_map_shifts_the_tokens(random_variables):
    """Such a window is two coarse tokens wide: four tokens, eight sectors of the image."""
    net = CircularSwin(BACKBONE)
    variables = random_variables(net, POLAR)
    apply = jax.jit(net.apply)
    straight, turned = (apply(variables, image)[0] for image in (POLAR, jnp.roll(POLAR, 8, axis=2)))
    np.testing.assert_allclose(turned, jnp.roll(straight, 4, axis=2), atol=1e-4)
    assert jnp.abs(straight - jnp.roll(straight, 4, axis=2)).max() > 1e-2


def test_the_head_that_goes_around_does_not_feel_a_shift(random_variables):
    head, features = PlaceHead(HEAD, circular=True), jax.random.normal(jax.random.key(2), (2, 4, 16, 8))
    variables = random_variables(head, features)
    apply = jax.jit(head.apply)
    descriptor, seen = apply(variables, features)
    shifted, seen_shifted = apply(variables, jnp.roll(features, 4, axis=2))
    assert seen["head_convolution1"].shape == (2, 2, 8, 8)
    for name, shift in (("cbam", 4), ("head_convolution1", 2)):
        np.testing.assert_allclose(seen_shifted[name], jnp.roll(seen[name], shift, axis=2), atol=1e-4)
    np.testing.assert_allclose(shifted, descriptor, atol=1e-5)


def test_quarter_turns_leave_the_descriptor(params):
    straight = describe(params, BEV)
    assert jnp.abs(straight[0] - straight[1]).max() > 1e-3
    for quarters in (1, 2, 3):
        np.testing.assert_allclose(describe(params, jnp.rot90(BEV, quarters, axes=(1, 2))), straight, atol=2e-5)


@pytest.mark.slow
def test_descriptors_and_logits_under_jit_vmap_and_grad(params):
    whole, logits = describe(params, BEV), segment(params, BEV)
    assert whole.shape == (3, 256) and logits.shape == (3, 32, 32, 20)
    np.testing.assert_allclose(jnp.linalg.norm(whole, axis=-1), 1.0, atol=1e-5)
    np.testing.assert_allclose(jax.jit(jax.vmap(lambda bev: describe(params, bev)))(BEV), whole, atol=1e-5)
    np.testing.assert_allclose(jax.jit(jax.vmap(lambda bev: segment(params, bev)))(BEV), logits, atol=1e-4)
    gradient = jax.jit(jax.grad(lambda bev: describe(params, bev)[..., 0].sum()))(jnp.zeros_like(BEV))
    assert jnp.isfinite(gradient).all()


@pytest.mark.slow
def test_no_array_has_a_rank_above_five(params):
    def loss(weights):
        outputs = forward(dataclasses.replace(params, weights=weights), BEV)
        return outputs.descriptor.sum() + outputs.logits.sum()

    equations = all_equations(jax.make_jaxpr(jax.grad(loss))(params.weights).jaxpr)
    assert max(value.aval.ndim for equation in equations for value in equation.outvars) <= 5


def all_equations(jaxpr):
    for equation in jaxpr.eqns:
        yield equation
        for inner in jaxprs_in_params(equation.params):
            yield from all_equations(inner)


def test_heat_maps_show_encoder_decoder_and_cbam(params):
    found = heat_maps(params, BEV[0])
    assert set(found) == {"stem", "encoder, first", "encoder, last", "decoder", "CBAM"}
    assert all(heat.shape == (32, 32) for heat in found.values())


def test_weights_come_back_from_disk(params, tmp_path):
    loaded = load(save(params, tmp_path / "weights"))
    assert loaded.config == CONFIG
    np.testing.assert_allclose(describe(loaded, BEV), describe(params, BEV), atol=1e-6)


def test_the_preset_is_of_the_size_that_ships_and_its_mlps_double_the_channels():
    shapes = weight_shapes(model_preset("sglpr"))
    assert sum(map(math.prod, shapes.values())) <= 7.4e6  # 15 MB as float16
    assert shapes["backbone/swin_unet/encoder_0/block_0/mlp_in/kernel"] == (64, 128)


def test_what_does_not_fit_is_an_error():
    with pytest.raises(ValueError, match="polar"):
        ModelConfig(backbone=BACKBONE)
    with pytest.raises(ValueError, match=r"head\.means requires a polar image"):
        ModelConfig(head=HeadConfig(means=(1, 1, 1)))
    with pytest.raises(ValueError, match="a number of heads for each"):
        SglprConfig(depths=(2,))
    with pytest.raises(ValueError, match=r"multiple of \(8, 4\) cells"):
        dataclasses.replace(CONFIG, polar=(20, 32))
    with pytest.raises(ValueError, match="3 x 3 kernels"):
        HeadConfig(channels=(8,), kernels=(4,), strides=(1,), means=(1,))
