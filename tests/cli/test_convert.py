"""bin/convert turns PyTorch weights into a folder of initial weights for bin/train."""

import jax
import numpy as np
import pytest
import safetensors.numpy

import sglpr_jax
from sglpr_jax.models.torch_import import torch_name
from sglpr_jax.models.weights import by_name
from sglpr_jax.training.presets import load_preset

MODEL = """
import dataclasses

from sglpr_jax.grid import Grid
from sglpr_jax.models.backbone_config import SwinConfig
from sglpr_jax.models.config import HeadConfig
from sglpr_jax.models.config import model_preset
from sglpr_jax.training.config import TrainConfig

MODEL = dataclasses.replace(
    model_preset("tiny"),
    grid=Grid(resolution_m=3.2, height=32, width=32),
    backbone=SwinConfig(embed_dim=8, depths=(1, 1), heads=(1, 2), window=4),
    head=HeadConfig(channels=(16,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=4),
)
CONFIG = TrainConfig(model=MODEL, steps=1)
"""


@pytest.fixture
def preset(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(MODEL)
    return path


@pytest.fixture
def state(preset):
    """A Swin-Unet by PyTorch's names, every weight full of one number of its own."""
    shapes = by_name(sglpr_jax.init(jax.random.key(7), config=load_preset(str(preset)).model).weights)
    ours = {name: leaf for name, leaf in shapes.items() if not name.startswith("place_head/")}
    return {
        torch_name(name): _torch_layout(name, np.full(leaf.shape, i / 100))
        for i, (name, leaf) in enumerate(ours.items())
    }


def _torch_layout(name, values):
    values = values.astype(np.float32)
    if name.endswith("kernel"):
        values = np.moveaxis(values, (-1, -2), (0, 1))
    return np.ascontiguousarray(values[..., None, None] if name == "segmentation_head/kernel" else values)


def written(path, weights):
    safetensors.numpy.save_file(weights, path)
    return path


def test_swin_t_fills_the_matching_layers_and_lists_the_unused_ones(command, preset, state, tmp_path):
    encoder = {name: value for name, value in state.items() if name.startswith(("patch_embed.", "layers.", "norm."))}
    file = written(tmp_path / "t.safetensors", {**encoder, "head.weight": np.zeros((10, 16), np.float32)})
    ended = command("convert", file, "--preset", preset, "--out", tmp_path / "start")
    assert ended.status == 0, ended.error
    assert f"not used by {preset}: head.weight" in ended.out
    values = by_name(sglpr_jax.load(tmp_path / "start").weights)
    expected = state["layers.0.blocks.0.mlp.fc1.weight"].reshape(-1)[0]
    for place in ("encoder_0", "decoder_1"):
        assert (values[f"backbone/{place}/block_0/mlp_in/kernel"] == expected).all()
