"""Import of the published PyTorch Swin-Unet and Swin-T from safetensors files, by the names of the weights."""

import dataclasses
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from sglpr_jax.files import in_short, naming
from sglpr_jax.models.backbone_config import SwinConfig
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.params import Params
from sglpr_jax.models.weights import as_tree, by_name, weight_shapes

_RULES = (
    (r"^backbone/", ""),
    (r"^encoder_(\d+)_merge/", r"layers.\1.downsample/"),
    (r"^encoder_(\d+)/block_(\d+)/", r"layers.\1.blocks.\2/"),
    (r"^decoder_0_expand/", "layers_up.0/"),
    (r"^decoder_(\d+)_expand/", r"layers_up.\1.upsample/"),
    (r"^decoder_(\d+)_fuse/", r"concat_back_dim.\1/"),
    (r"^decoder_(\d+)/block_(\d+)/", r"layers_up.\1.blocks.\2/"),
    (r"^expand/", "up/"),
    (r"^segmentation_head/", "output/"),
    (r"/attention_norm/", "/norm1/"),
    (r"/mlp_norm/", "/norm2/"),
    (r"/mlp_in/", "/mlp.fc1/"),
    (r"/mlp_out/", "/mlp.fc2/"),
    (r"/attention/position_bias$", "/attn.relative_position_bias_table"),
    (r"/attention/", "/attn/"),
    (r"/projection/", "/proj/"),
    (r"/(kernel|scale)$", "/weight"),
    (r"/", "."),
)
"""Replacements that convert the weight names of this project to PyTorch's, applied in order."""

_BUFFERS = ("relative_position_index", "attn_mask")
"""Tables that PyTorch stores with the weights. Here they follow from the configuration."""

PICKLES = (".pth", ".pt", ".bin", ".ckpt")
"""File name extensions of PyTorch's own checkpoints."""

_SWIN_T_ONLY = re.compile(r"head\.(weight|bias)|layers\.\d+\.(blocks\.\d+|downsample)\..+")
"""Weights of ImageNet's Swin-T that a Swin-Unet may lack: the classifier, and a deeper third stage."""


def import_swin_unet(params: Params, path: Path | str) -> Params:
    """Load the backbone, the expansion and the segmentation head from a Swin-Unet checkpoint. The place head is kept.

    A patch embedding of three channels is summed into one, because PyTorch's network repeats a grey image three times.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file is not a safetensors file, or if names or shapes differ from the model.
    """
    with naming(path):
        weights = from_torch_names(read_checkpoint(Path(path)), params.config)
    return dataclasses.replace(params, weights={**params.weights, **weights})


def import_swin_t(params: Params, path: Path | str) -> tuple[Params, tuple[str, ...], tuple[str, ...]]:
    """Load the encoder from an ImageNet Swin-T, and copy its blocks to the mirrored decoder stages.

    Swin-Unet's own code does the same. Weights of another shape, and weights without a counterpart in Swin-T, are kept.

    Returns:
      The new parameters, the names of their copied weights, and the names of the unused weights of the checkpoint.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file is not a safetensors file, or if no weight fits.
    """
    with naming(path):
        state, shapes = read_checkpoint(Path(path)), _expected_shapes(params.config)
        backbone = params.config.backbone
        assert isinstance(backbone, SwinConfig)  # checked by `_expected_shapes`
        last = len(backbone.depths) - 1

        def encoder_name(name: str) -> str:
            return re.sub(r"^layers_up\.(\d+)\.blocks", lambda m: f"layers.{last - int(m[1])}.blocks", torch_name(name))

        sources = {name: source for name in shapes if (source := encoder_name(name)) in state}
        converted = {name: _flax_layout(name, state[source]) for name, source in sources.items()}
        fitting = {name: weight for name, weight in converted.items() if weight.shape == shapes[name]}
        unused = sorted(set(state) - {sources[name] for name in fitting})
        unknown = [name for name in unused if name not in sources.values() and not _SWIN_T_ONLY.fullmatch(name)]
        if unknown:
            raise ValueError(f"not a weight of Swin-T: {unknown[0]} ({len(unknown)} unknown names)")
        if not fitting:
            raise ValueError("expected weights that fit the model, found none; Swin-T fits 96 channels and window 7")
    weights = as_tree({**by_name(params.weights), **fitting})
    return dataclasses.replace(params, weights=weights), tuple(fitting), tuple(unused)


def read_checkpoint(path: Path) -> dict[str, np.ndarray]:
    """Read the weights of a .safetensors file by PyTorch's names, as float32, without buffers and prefixes.

    A .pth file is a pickle, which can run code, so it is not opened.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If it is another kind of file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a checkpoint, found no file")
    try:
        content = safetensors.numpy.load_file(path)
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
        pickled = path.suffix in PICKLES or zipfile.is_zipfile(path)
        found = "a pickle of PyTorch's, which this project does not open" if pickled else f"none ({in_short(error)})"
        raise ValueError(
            f"expected a .safetensors file, found {found}; to convert it see docs/guides/weights.md"
        ) from error
    return {
        name.removeprefix("module.").removeprefix("swin_unet."): value.astype(np.float32)
        for name, value in content.items()
        if not name.endswith(_BUFFERS)
    }


def from_torch_names(state: dict[str, np.ndarray], config: ModelConfig) -> dict[str, Any]:
    """Convert a whole Swin-Unet with PyTorch's names to the tree of weights without the place head.

    Raises:
      ValueError: If a weight is missing, unknown or of the wrong shape. The message names the first one.
    """
    expected = _expected_shapes(config)
    unknown = set(state) - {torch_name(name) for name in expected}
    if unknown:
        raise ValueError(f"not a weight of Swin-Unet: {min(unknown)} ({len(unknown)} unknown names)")
    weights = {}
    for name, shape in expected.items():
        source = torch_name(name)
        if source not in state:
            raise ValueError(f"expected a weight {source}, found none")
        weights[name] = _flax_layout(name, state[source])
        if weights[name].shape != shape:
            raise ValueError(f"{source}: expected shape {shape} (in Flax's axis order), found {weights[name].shape}")
    return as_tree(weights)


def torch_name(name: str) -> str:
    """Return PyTorch's name of a weight.

    For `backbone/encoder_0/block_1/mlp_in/kernel` it is `layers.0.blocks.1.mlp.fc1.weight`.
    """
    for pattern, replacement in _RULES:
        name = re.sub(pattern, replacement, name)
    return name


def _expected_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """Return the shapes of all weights but those of the place head, which a Swin-Unet has, too.

    Raises ValueError if the model has another backbone or none.
    """
    if not config.head.reads_features:
        raise ValueError(f"expected a model with a backbone, found a place head that reads {config.head.input}")
    if not isinstance(config.backbone, SwinConfig):
        raise ValueError(f"expected a model with the backbone 'swin', found {config.backbone.kind!r}")
    return {name: leaf.shape for name, leaf in weight_shapes(config).items() if not name.startswith("place_head/")}


def _flax_layout(name: str, weight: np.ndarray) -> np.ndarray:
    """Convert PyTorch's (out, in, ...) to Flax's (..., in, out). The bias tables are (rows, heads) in both."""
    if name == "backbone/patch_embed/projection/kernel":
        weight = weight.sum(1, keepdims=True)
    if name == "segmentation_head/kernel":
        weight = weight[..., 0, 0]
    if not name.endswith("kernel"):
        return weight
    return weight.transpose(*range(2, weight.ndim), 1, 0)
