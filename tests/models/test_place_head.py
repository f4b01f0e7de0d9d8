"""The place head: CBAM and NetVLAD against PyTorch, and convolutions that border maps as PyTorch does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.cbam import CBAM, ChannelGate
from sglpr_jax.models.config import HeadConfig
from sglpr_jax.models.netvlad import GatedNetVLAD
from sglpr_jax.models.place_head import PlaceHead

SPATIAL = "SpatialGate.spatial"
LAYERS = {
    "assignment": ("cluster_weights", "cluster_biases", "bn1"),
    "hidden": ("hidden1_weights", None, "bn2"),
    "gate": ("context_gating.gating_weights", "context_gating.gating_biases", "context_gating.bn1"),
}
"""Dense layers of NetVLAD, and PyTorch's weights, bias and batch norm of each."""


def batch_norm(state, name):
    """Factor and bias of a batch norm, which is folded into the layer before it."""
    scale = state[f"{name}.weight"] / jnp.sqrt(state[f"{name}.running_var"] + 1e-5)
    return scale, state[f"{name}.bias"] - state[f"{name}.running_mean"] * scale


def cbam(state, image, *, reduction):
    mlp = {ours: f"ChannelGate.mlp.{number}" for ours, number in (("mlp_in", 1), ("mlp_out", 3))}
    channel = {ours: {"kernel": state[f"{t}.weight"].T, "bias": state[f"{t}.bias"]} for ours, t in mlp.items()}
    if f"{SPATIAL}.conv.weight" not in state:
        return ChannelGate(reduction).apply({"params": channel}, image.transpose(0, 2, 3, 1)).transpose(0, 3, 1, 2)
    scale, bias = batch_norm(state, f"{SPATIAL}.bn")
    kernel = state[f"{SPATIAL}.conv.weight"].transpose(2, 3, 1, 0) * scale[None, None, None]
    params = {"channel": channel, "spatial": {"convolution": {"kernel": kernel, "bias": bias}}}
    return CBAM(reduction).apply({"params": params}, image.transpose(0, 2, 3, 1)).transpose(0, 3, 1, 2)


def netvlad(state, image):
    params = {"centres": state["cluster_weights2"][0]}
    for ours, (weights, biases, norm) in LAYERS.items():
        if f"{norm}.weight" in state:
            scale, bias = batch_norm(state, norm)
            params[ours] = {"kernel": state[weights] * scale[None], "bias": bias}
        elif weights in state:
            params[ours] = {"kernel": state[weights], "bias": state.get(biases)}
    features = image.transpose(0, 2, 3, 1).reshape(len(image), -1, image.shape[1])
    return GatedNetVLAD(clusters=8, output=16).apply({"params": params}, features)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "tag", "options"),
    [
        ("cbam", "c32_r4", {"reduction": 4}),
        ("cbam", "c32_r4_nospatial", {"reduction": 4}),
        ("netvlad", "loupe_gating1_bn1", {}),
    ],
)
def test_output_and_gradients_are_those_of_pytorch(file, tag, options, golden, assert_parity):
    expected = {key.removeprefix(f"{tag}/"): x for key, x in golden(file).items() if key.startswith(f"{tag}/")}
    state = {key.removeprefix("state/"): jnp.asarray(x) for key, x in expected.items() if key.startswith("state/")}
    state = {name: x for name, x in state.items() if not name.endswith("num_batches_tracked")}
    module = {"cbam": cbam, "netvlad": netvlad}[file]

    @jax.jit
    @jax.grad
    def gradients(state_and_image):
        out = module(*state_and_image, **options)
        return jnp.sum(out * jnp.cos(jnp.arange(out.size, dtype=jnp.float32)).reshape(out.shape))

    image = jnp.asarray(expected["input"])
    assert_parity(module(state, image, **options), expected["eval"], "eval")
    by_name, by_image = gradients((state, image))
    assert_parity(by_image, expected["eval_input_grad"], "eval_input_grad")
    names = [key.removeprefix("eval_gradnorm/") for key in expected if key.startswith("eval_gradnorm/")]
    assert len(names) >= 4
    for name in names:
        assert_parity(jnp.linalg.norm(by_name[name]), expected[f"eval_gradnorm/{name}"], name)


def head(kernels, strides):
    return PlaceHead(HeadConfig(channels=(8, 12, 16), kernels=kernels, strides=strides, clusters=4, descriptor_size=32))


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
