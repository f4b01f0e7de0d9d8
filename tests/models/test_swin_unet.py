"""What the Swin-Unet promises beyond its numbers: purity, stochastic depth, transformations, clear errors."""

import dataclasses

import flax.linen as nn
import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax import losses
from sglpr_jax.models.backbone_config import CircularConfig, SglprConfig, SwinConfig
from sglpr_jax.models.config import HeadConfig, ModelConfig, model_preset
from sglpr_jax.models.layers import LayerNorm
from sglpr_jax.models.sglpr import init
from sglpr_jax.models.swin import PatchExpand, SwinBlock, WindowAttention
from sglpr_jax.models.swin_unet import CircularSwin, SwinUnet
from sglpr_jax.models.torch_import import from_torch_names, torch_name

MODEL = SwinUnet(SwinConfig(embed_dim=8, depths=(2, 2), heads=(1, 2), window=4, drop_path=0.5))


@pytest.fixture(scope="module")
def images():
    return jnp.asarray(np.random.default_rng(0).poisson(0.5, size=(3, 32, 32, 1)), jnp.float32)


@pytest.fixture(scope="module")
def variables(random_variables, images):
    return random_variables(MODEL, images)


@pytest.fixture(scope="module")
def tokens(variables, images):
    return jax.jit(MODEL.apply)(variables, images)[0]


def test_stochastic_depth_follows_its_key_and_is_off_outside_training(variables, images, tokens):
    @jax.jit
    def train(key):
        return MODEL.apply(variables, images, train=True, rngs={"drop_path": key})[0]

    first, again, other = (train(jax.random.key(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3
    assert np.abs(first - tokens).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("height, down", [(4, 0), (8, 2)])
def test_windows_are_shifted_in_each_direction_that_is_larger_than_them(height, down, random_variables):
    """Against windows gathered token by token, in a circular map; a row may not see one that was rolled in."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=(1, height, 12, 8)), jnp.float32)
    block = SwinBlock(heads=2, window=4, shifted=True, circular=True, shift_each_way=True)
    variables = random_variables(block, x)
    normed = LayerNorm().apply({"params": variables["params"]["attention_norm"]}, x)[0]
    attention = {"params": variables["params"]["attention"]}
    expected = np.zeros(normed.shape, np.float32)
    for top, left in np.ndindex(height // 4, 3):
        rows = (np.arange(4) + 4 * top + down) % height
        columns = (np.arange(4) + 4 * left + 2) % 12
        tokens = np.ix_(rows, columns)
        apart = np.repeat(np.abs(rows[:, None] - rows[None]) > 4, 4, 0).repeat(4, 1)
        found = WindowAttention(heads=2).apply(attention, normed[tokens].reshape(1, 16, 8), apart[None])
        expected[tokens] = np.reshape(found, (4, 4, 8))
    middle = x[0] + expected
    whole = middle + block_mlp(variables["params"], middle)
    np.testing.assert_allclose(block.apply(variables, x)[0], whole, atol=1e-4)


def block_mlp(params, x):
    """The second branch of a block, from its weights."""
    normed = np.asarray(LayerNorm().apply({"params": params["mlp_norm"]}, x))
    hidden = jax.nn.gelu(normed @ params["mlp_in"]["kernel"] + params["mlp_in"]["bias"][None, None], approximate=False)
    return np.asarray(hidden) @ params["mlp_out"]["kernel"] + params["mlp_out"]["bias"][None, None]


def test_windows_that_do_not_tile_the_map_are_refused():
    with pytest.raises(ValueError, match=r"windows of 4 x 4 tokens must tile the map, found 6 x 6 tokens"):
        MODEL.init(jax.random.key(0), jnp.zeros((1, 24, 24, 1)))


def run(weights: dict, image: jax.Array, labels: jax.Array, config: ModelConfig):
    """The joint segmentation loss, with every named map and both of its terms."""
    swin = config.backbone
    backbone = SwinUnet(swin)
    tokens, seen = backbone.apply({"params": weights["backbone"]}, image)
    pixels = PatchExpand(swin.patch, swin.embed_dim).apply({"params": weights["expand"]}, tokens)
    logits = nn.Dense(config.classes, use_bias=False).apply({"params": weights["segmentation_head"]}, pixels)
    ce, dice = losses.cross_entropy(logits, labels).mean(), losses.dice_from_sums(losses.dice_sums(logits, labels))
    return 0.4 * ce + 0.6 * dice, {**seen, "up_x4": pixels, "logits": logits, "ce": ce, "dice": dice}


@pytest.mark.slow
def test_every_stage_loss_and_gradient_agrees(golden, assert_parity, model_config):
    expected = golden("swinunet_w4_img64_odd_depths")
    config = model_config(expected)
    state = {name.removeprefix("param/"): value for name, value in expected.items() if name.startswith("param/")}
    weights = from_torch_names(state, config)
    image = jnp.asarray(expected["input"].transpose(0, 2, 3, 1))
    labels = jnp.asarray(expected["labels"], jnp.int32)
    differentiate = jax.jit(jax.value_and_grad(run, (0, 1), has_aux=True), static_argnums=3)
    (loss, seen), (weight_gradients, image_gradient) = differentiate(weights, image, labels, config)

    for name in ("ce", "dice"):
        assert_parity(seen.pop(name), expected[name], name)
    assert_parity(loss, expected["loss"], "loss")
    check_maps(seen, expected, assert_parity)
    assert_parity(np.linalg.norm(image_gradient), expected["gradnorm_input"], "gradnorm_input")
    check_gradients(weight_gradients, expected, assert_parity)


def check_maps(seen, expected, assert_parity):
    """Every map has its statistics in the file, and most are there in full (the last two with a stride)."""
    stages = {key.removeprefix("stats/") for key in expected if key.startswith("stats/")}
    assert stages == set(seen)
    for name, found in seen.items():
        found = np.asarray(found)
        if name == "logits":
            found = found.transpose(0, 3, 1, 2)
        mean, std, largest, projection = expected[f"stats/{name}"]
        flat = found.astype(np.float64).reshape(-1)
        statistics = [flat.mean(), flat.std(ddof=1), np.abs(flat).max()]
        assert_parity([*statistics, largest], [mean, std, largest, largest], f"stats/{name}")
        # Errors of the sum's terms are independent: they grow with the root of its length.
        change = flat @ np.cos(0.1 * np.arange(flat.size)) - projection
        assert abs(change) <= 1e-4 * largest * flat.size**0.5, name
        if f"out/{name}" in expected:
            assert_parity(as_stored(found, name, int(expected["stride"])), expected[f"out/{name}"], f"out/{name}")


def as_stored(found, name, stride):
    """A map in the file's layout: (b, h * w, c), the last two as images with a stride."""
    if name == "logits":
        return found[:, :, ::stride, ::stride]
    if name == "up_x4":
        return found[:, ::stride, ::stride]
    return found.reshape(len(found), -1, found.shape[-1])


def check_gradients(gradients, expected, assert_parity):
    """The norm for every weight, and the whole gradient where the file has it."""
    flat = flax.traverse_util.flatten_dict(gradients, sep="/")
    found = {torch_name(name): np.asarray(gradient) for name, gradient in flat.items()}
    assert set(found) == set(expected["gradnorm_names"])
    for name, norm in zip(expected["gradnorm_names"], expected["gradnorm"], strict=True):
        assert_parity(np.linalg.norm(found[name]), norm, f"gradnorm/{name}")
    for key in expected:
        if key.startswith("grad/"):
            gradient = found[key.removeprefix("grad/")]
            whole = expected[key]
            is_table = key.endswith("bias_table")
            moved = whole if is_table else whole.transpose(*range(2, whole.ndim), *reversed(range(min(2, whole.ndim))))
            assert_parity(gradient, moved.reshape(gradient.shape), key)


STEM = CircularConfig(widths=(4, 6), strides=(2, 1), means=(1, 1), fine=())
BACKBONE = SglprConfig(stem=STEM, embed_dim=8, depths=(2, 2), heads=(1, 2), window=2)
POLAR = jax.random.normal(jax.random.key(0), (2, 16, 32, 2))


def test_a_turn_by_windows_of_the_coarsest_map_shifts_the_tokens(random_variables):
    """Such a window is two coarse tokens wide: four tokens, eight sectors of the image."""
    net = CircularSwin(BACKBONE)
    variables = random_variables(net, POLAR)
    apply = jax.jit(net.apply)
    straight, turned = (apply(variables, image)[0][-1] for image in (POLAR, jnp.roll(POLAR, 8, axis=2)))
    np.testing.assert_allclose(turned, jnp.roll(straight, 4, axis=2), atol=1e-4)
    assert jnp.abs(straight - jnp.roll(straight, 4, axis=2)).max() > 1e-2


def test_what_does_not_fit_is_an_error():
    with pytest.raises(ValueError, match="'sglpr' requires a polar image"):
        ModelConfig(backbone=BACKBONE)
    with pytest.raises(ValueError, match=r"head\.means requires a polar image"):
        ModelConfig(head=HeadConfig(means=(1, 1, 1)))
    with pytest.raises(ValueError, match="a number of heads for each"):
        SglprConfig(depths=(2,))
    with pytest.raises(ValueError, match="3 x 3 kernels"):
        HeadConfig(channels=(8,), kernels=(4,), strides=(1,), means=(1,))
    config = dataclasses.replace(model_preset("sglpr-small"), polar=(64, 360))
    with pytest.raises(ValueError, match=r"means: expected a polar map that 1 x 2 pixels tile, found \d+ x 45 pixels"):
        jax.eval_shape(lambda: init(jax.random.key(0), config=config))
