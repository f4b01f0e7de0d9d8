"""The Swin-Unet against the PyTorch reference: every stage, the logits, the losses and the gradient of every weight."""

import flax.linen as nn
import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax import losses
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.swin import FinalPatchExpand
from sglpr_jax.models.swin_unet import SwinUnet
from sglpr_jax.models.torch_import import from_torch_names, torch_name

FILES = (
    "swinunet_w4_img64_odd_depths",
    "swinunet_full_formula",
    pytest.param("swinunet_w4_img128_c12_b2", marks=pytest.mark.slow),
    pytest.param("swinunet_w7_img224_c12_in1_b1", marks=pytest.mark.slow),
)


def run(weights: dict, image: jax.Array, labels: jax.Array, config: ModelConfig):
    """The joint segmentation loss, with every named map and both of its terms."""
    swin = config.backbone
    backbone = SwinUnet(swin.embed_dim, swin.depths, swin.heads, swin.window, drop_path=swin.drop_path)
    tokens, seen = backbone.apply({"params": weights["backbone"]}, image)
    pixels = FinalPatchExpand(swin.patch).apply({"params": weights["expand"]}, tokens)
    logits = nn.Dense(config.classes, use_bias=False).apply({"params": weights["segmentation_head"]}, pixels)
    ce, dice = losses.cross_entropy(logits, labels).mean(), losses.dice(logits, labels)
    return 0.4 * ce + 0.6 * dice, {**seen, "up_x4": pixels, "logits": logits, "ce": ce, "dice": dice}


@pytest.mark.slow
@pytest.mark.parametrize("file", FILES)
def test_every_stage_loss_and_gradient_agrees(file, golden, assert_parity, model_config):
    expected = golden(file)
    config, channels = model_config(expected)
    if "input" not in expected:
        expected |= formula_weights(expected, channels)
    state = {name.removeprefix("param/"): value for name, value in expected.items() if name.startswith("param/")}
    weights = from_torch_names(state, config, input_channels=channels)
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


def formula_weights(expected, channels):
    """The full-size file's input, labels and 27 million weights, which follow from a formula (a splitmix64 hash)."""
    config_shapes = full_size_shapes()
    names = sorted(config_shapes)
    made = {f"param/{name}": formula_weight(name, config_shapes[name], k) for k, name in enumerate(names, 1)}
    row, column = np.mgrid[:224, :224] // 16
    image = uniform(0, (1, channels, 224, 224)).astype(np.float32)
    return {**made, "input": image, "labels": ((row * 7 + column * 3) % 18)[None].astype(np.uint8)}


def uniform(k, shape):
    """Values of mean 0 and variance 1 for the k-th tensor, float64."""
    i = np.arange(np.prod(shape), dtype=np.uint64)
    with np.errstate(over="ignore"):
        z = (i + np.uint64(k * 2**32 + 1)) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
    return (((z >> np.uint64(40)).astype(np.float64) / 2**24 - 0.5) * 12**0.5).reshape(shape)


def formula_weight(name, shape, k):
    u = uniform(k, shape)
    if name.endswith("relative_position_bias_table"):
        return (0.5 * u).astype(np.float32)
    if len(shape) > 1:
        return (u / np.prod(shape[1:]) ** 0.5).astype(np.float32)
    return (1 + 0.1 * u if name.endswith("weight") else 0.1 * u).astype(np.float32)


def full_size_shapes():
    """PyTorch's name and shape of every weight of the full-size model, written out from the reference's tables."""
    shapes = {
        "patch_embed.proj.weight": (96, 3, 4, 4),
        "patch_embed.proj.bias": (96,),
        "up.expand.weight": (1536, 96),
        "output.weight": (20, 96, 1, 1),
    }
    norms = {"patch_embed.norm": 96, "norm": 768, "norm_up": 96, "up.norm": 96}
    for stage in range(4):
        c, heads = 96 * 2**stage, 3 * 2**stage
        for side in [f"layers.{stage}"] + [f"layers_up.{3 - stage}"] * (stage < 3):
            for block in range(2):
                prefix = f"{side}.blocks.{block}"
                norms |= {f"{prefix}.norm1": c, f"{prefix}.norm2": c}
                shapes[f"{prefix}.attn.relative_position_bias_table"] = (169, heads)
                dense = {"attn.qkv": (3 * c, c), "attn.proj": (c, c), "mlp.fc1": (4 * c, c), "mlp.fc2": (c, 4 * c)}
                shapes |= {f"{prefix}.{name}.weight": shape for name, shape in dense.items()}
                shapes |= {f"{prefix}.{name}.bias": shape[:1] for name, shape in dense.items()}
        if stage < 3:
            norms[f"layers.{stage}.downsample.norm"] = 4 * c
            shapes[f"layers.{stage}.downsample.reduction.weight"] = (2 * c, 4 * c)
            shapes[f"concat_back_dim.{3 - stage}.weight"] = (c, 2 * c)
            shapes[f"concat_back_dim.{3 - stage}.bias"] = (c,)
        if stage > 0:
            up = "layers_up.0" if stage == 3 else f"layers_up.{3 - stage}.upsample"
            norms[f"{up}.norm"] = c // 2
            shapes[f"{up}.expand.weight"] = (2 * c, c)
    return shapes | {f"{name}.{part}": (size,) for name, size in norms.items() for part in ("weight", "bias")}


def test_full_size_model_has_the_references_number_of_weights():
    assert sum(int(np.prod(shape)) for shape in full_size_shapes().values()) == 27_169_956
