"""bin/convert turns PyTorch weights into a folder of initial weights for bin/train."""

import numpy as np
import safetensors.numpy

import sglpr_jax
from sglpr_jax.models.weights import by_name


def test_swin_t_fills_the_matching_layers_and_lists_the_unused_ones(command, preset, tmp_path):
    mlp = np.full((32, 8), 0.5, np.float32)
    file = {"layers.0.blocks.0.mlp.fc1.weight": mlp, "head.weight": np.zeros((10, 16), np.float32)}
    safetensors.numpy.save_file(file, tmp_path / "t.safetensors")
    ended = command("convert", tmp_path / "t.safetensors", "--preset", preset, "--out", tmp_path / "start")
    assert ended.status == 0, ended.error
    assert f"not used by {preset}: head.weight" in ended.out
    values = by_name(sglpr_jax.load(tmp_path / "start").weights)
    assert (values["backbone/encoder_0/block_0/mlp_in/kernel"] == 0.5).all()
