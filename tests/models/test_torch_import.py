"""Import of PyTorch weights by name. The numbers of imported models are the parity tests' subject."""

import pickle
from pathlib import Path

import flax.traverse_util
import jax
import numpy as np
import pytest
import safetensors.numpy

from sglpr_jax.models.config import HeadConfig, ModelConfig
from sglpr_jax.models.sglpr import init
from sglpr_jax.models.torch_import import from_torch_names, import_swin_t, import_swin_unet, torch_name
from sglpr_jax.models.weights import Params


@pytest.fixture
def state(golden):
    weights = golden("swinunet_w4_img64_odd_depths").items()
    return {name.removeprefix("param/"): value for name, value in weights if name.startswith("param/")}


@pytest.fixture
def params(golden, model_config) -> Params:
    config = model_config(golden("swinunet_w4_img64_odd_depths"))
    head = HeadConfig(channels=(8, 8, 8), kernels=(4, 3, 3), strides=(4, 2, 2), clusters=4)
    config = ModelConfig(**{**vars(config), "head": head})
    shapes = jax.eval_shape(lambda key: init(key, config=config), jax.random.key(0))
    return jax.tree.map(lambda leaf: np.full(leaf.shape, 0.5, leaf.dtype), shapes)


@pytest.fixture
def checkpoint(tmp_path):
    """Writes a checkpoint's weights as safetensors."""

    def save(weights):
        path = tmp_path / "model.safetensors"
        safetensors.numpy.save_file({name: np.ascontiguousarray(value) for name, value in weights.items()}, path)
        return path

    return save


def leaves(tree):
    return flax.traverse_util.flatten_dict(tree, sep="/")


def test_swin_unet_checkpoint_with_prefix_buffers_and_three_channels(state, params, checkpoint):
    embedding = state["patch_embed.proj.weight"]
    state["patch_embed.proj.weight"] = np.repeat(embedding / 3, 3, axis=1)
    state["layers.0.blocks.0.attn.relative_position_index"] = np.zeros((16, 16), np.int64)
    state["layers.0.blocks.1.attn_mask"] = np.zeros((4, 16, 16), np.float32)
    path = checkpoint({f"module.swin_unet.{name}": value for name, value in state.items()})
    imported = leaves(import_swin_unet(params, path).weights)

    assert imported.keys() == leaves(params.weights).keys()
    for name, value in imported.items():
        if name.startswith("place_head/"):
            assert (value == 0.5).all()
        elif name != "backbone/patch_embed/projection/kernel":
            assert value.sum() == pytest.approx(state[torch_name(name)].sum(), abs=1e-4)
    kernel = imported["backbone/patch_embed/projection/kernel"]
    np.testing.assert_allclose(kernel, embedding.transpose(2, 3, 1, 0), rtol=1e-6)


@pytest.mark.slow
def test_swin_t_fills_the_encoder_and_the_mirrored_decoder_where_shapes_match(state, params, checkpoint):
    """The small model plays Swin-T: encoder names only, plus what ImageNet's has more, and one other window size."""
    swin_t = {name: value for name, value in state.items() if name.startswith(("patch_embed.", "layers.", "norm."))}
    swin_t |= {"head.weight": np.zeros((1000, 64)), "layers.2.blocks.5.norm1.weight": np.ones(32)}
    table = "layers.0.blocks.0.attn.relative_position_bias_table"
    swin_t[table] = np.zeros((169, 1))
    imported, copied, unused = import_swin_t(params, checkpoint(swin_t))

    weights = leaves(imported.weights)
    assert unused == ("head.weight", table, "layers.2.blocks.5.norm1.weight")
    expected = state["layers.1.blocks.0.mlp.fc1.weight"].T
    for place in ("encoder_1", "decoder_2"):
        np.testing.assert_array_equal(weights[f"backbone/{place}/block_0/mlp_in/kernel"], expected)
    for name in (
        "decoder_1_fuse/kernel",
        "decoder_1_expand/expand/kernel",
        "encoder_0/block_0/attention/position_bias",
    ):
        assert f"backbone/{name}" not in copied and (weights[f"backbone/{name}"] == 0.5).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"norm_up.weight": None}, "expected a weight norm_up.weight, found none"),
        ({"norm_up.gain": np.ones(8)}, "not a weight of Swin-Unet: norm_up.gain"),
        ({"norm_up.weight": np.ones(9)}, r"norm_up.weight: expected shape \(8,\) .* found \(9,\)"),
        ({"norm_up.weight": np.ones((8, 1))}, r"norm_up.weight: expected 1 axes .* found shape \(8, 1\)"),
        ({"patch_embed.proj.weight": np.ones(8)}, r"patch_embed.proj.weight: expected 4 axes .* found shape \(8,\)"),
        ({"output.weight": np.ones(8)}, r"output.weight: expected 4 axes .* found shape \(8,\)"),
    ],
)
def test_a_checkpoint_of_another_model_is_refused(change, message, state, params):
    changed = {name: value for name, value in {**state, **change}.items() if value is not None}
    with pytest.raises(ValueError, match=message):
        from_torch_names(changed, params.config)


class Bomb:
    """What runs when it is unpickled."""

    def __reduce__(self):
        return (Path.touch, (Path("exploded"),))


def test_a_pickle_is_not_opened_and_a_missing_file_is_named(params, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.pth").write_bytes(pickle.dumps(Bomb()))
    for load in (import_swin_unet, import_swin_t):
        with pytest.raises(
            ValueError, match=r"model\.pth: .*found a pickle of PyTorch's, .* see docs/guides/weights\.md"
        ):
            load(params, tmp_path / "model.pth")
    assert not Path("exploded").exists()
    with pytest.raises(FileNotFoundError, match=r"none.safetensors: expected a checkpoint, found no file"):
        import_swin_unet(params, tmp_path / "none.safetensors")
