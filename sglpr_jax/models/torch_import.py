"""Import of the published PyTorch weights of Swin-Unet and Swin-T from safetensors files."""

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
from sglpr_jax.models.sglpr import weight_shapes
from sglpr_jax.models.weights import Params, as_tree, by_name

_NAME_REPLACEMENTS = (
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
"""Replacements that convert a weight name of this project to PyTorch's, applied in this order."""

_BUFFERS = ("relative_position_index", "attn_mask")
"""Tables that PyTorch stores with the weights. Here they follow from the configuration."""

PICKLES = (".pth", ".pt", ".bin", ".ckpt")
"""File name extensions of PyTorch's own checkpoints."""

_SWIN_T_ONLY = re.compile(r"head\.(weight|bias)|layers\.\d+\.(blocks\.\d+|downsample)\..+")
"""Weights of ImageNet's Swin-T that a Swin-Unet may lack: the classifier, and a deeper third stage."""


def import_swin_unet(params: Params, path: Path | str) -> Params:
    """Return `params` with backbone, pixel expansion and segmentation head of a Swin-Unet checkpoint.

    The place head is kept. The three input channels of the patch embedding are summed into one, because PyTorch's
    network repeats a grey image three times.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file is not a safetensors file, or if names or shapes differ from the model.
    """
    with naming(path):
        weights = from_torch_names(read_checkpoint(Path(path)), params.config)
    return dataclasses.replace(params, weights={**params.weights, **weights})


def import_swin_t(params: Params, path: Path | str) -> tuple[Params, tuple[str, ...], tuple[str, ...]]:
    """Return `params` with the encoder of an ImageNet Swin-T, whose blocks also go to the mirrored decoder stages.

    Swin-Unet's own code does the same. Weights without a counterpart of the same shape in Swin-T are kept.

    Returns:
      The new parameters, the names of their replaced weights, and the names of the unused weights of the checkpoint.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file is not a safetensors file, or if no weight fits.
    """
    with naming(path):
        checkpoint, shapes = read_checkpoint(Path(path)), _expected_shapes(params.config)
        backbone = params.config.backbone
        assert isinstance(backbone, SwinConfig)  # checked by `_expected_shapes`
        last_stage = len(backbone.depths) - 1

        def swin_t_name(name: str) -> str:
            """Return PyTorch's name of a weight, and for a block of the decoder that of the mirrored encoder block."""

            def mirrored_stage(match: re.Match) -> str:
                return f"layers.{last_stage - int(match[1])}.blocks"

            return re.sub(r"^layers_up\.(\d+)\.blocks", mirrored_stage, torch_name(name))

        sources = {name: source for name in shapes if (source := swin_t_name(name)) in checkpoint}
        converted = {name: _flax_layout(name, checkpoint[at], shapes[name], at) for name, at in sources.items()}
        fitting = {name: weight for name, weight in converted.items() if weight.shape == shapes[name]}
        unused = sorted(set(checkpoint) - {sources[name] for name in fitting})
        unknown = [name for name in unused if name not in sources.values() and not _SWIN_T_ONLY.fullmatch(name)]
        if unknown:
            raise ValueError(f"not a weight of Swin-T: {unknown[0]} ({len(unknown)} unknown names)")
        if not fitting:
            raise ValueError("expected weights that fit the model, found none; Swin-T fits 96 channels and window 7")
    weights = as_tree({**by_name(params.weights), **fitting})
    return dataclasses.replace(params, weights=weights), tuple(fitting), tuple(unused)


def read_checkpoint(path: Path) -> dict[str, np.ndarray]:
    """Read the weights of a .safetensors file as float32, by PyTorch's names without the prefixes of wrappers.

    A .pth file is a pickle, which can run code. It is not opened.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If it is another kind of file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a checkpoint, found no file")
    try:
        content = safetensors.numpy.load_file(path)
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
        is_pickle = path.suffix in PICKLES or zipfile.is_zipfile(path)
        found = "a pickle of PyTorch's, which this project does not open" if is_pickle else f"none ({in_short(error)})"
        raise ValueError(
            f"expected a .safetensors file, found {found}; to convert it see docs/guides/weights.md"
        ) from error
    return {
        name.removeprefix("module.").removeprefix("swin_unet."): value.astype(np.float32)
        for name, value in content.items()
        if not name.endswith(_BUFFERS)
    }


def from_torch_names(checkpoint: dict[str, np.ndarray], config: ModelConfig) -> dict[str, Any]:
    """Convert a whole Swin-Unet to this project's tree of weights. Raises ValueError if a name or shape differs."""
    expected = _expected_shapes(config)
    unknown = set(checkpoint) - {torch_name(name) for name in expected}
    if unknown:
        raise ValueError(f"not a weight of Swin-Unet: {min(unknown)} ({len(unknown)} unknown names)")
    weights = {}
    for name, shape in expected.items():
        source = torch_name(name)
        if source not in checkpoint:
            raise ValueError(f"expected a weight {source}, found none")
        weights[name] = _flax_layout(name, checkpoint[source], shape, source)
        if weights[name].shape != shape:
            raise ValueError(f"{source}: expected shape {shape} (in Flax's axis order), found {weights[name].shape}")
    return as_tree(weights)


def torch_name(name: str) -> str:
    """Return `layers.0.blocks.1.mlp.fc1.weight` for `backbone/encoder_0/block_1/mlp_in/kernel`."""
    for pattern, replacement in _NAME_REPLACEMENTS:
        name = re.sub(pattern, replacement, name)
    return name


def _expected_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """Return the shapes of all weights except the place head's. Raises ValueError if the backbone is no Swin-Unet."""
    if not config.head.reads_features:
        raise ValueError(f"expected a model with a backbone, found a place head that reads {config.head.input}")
    if not isinstance(config.backbone, SwinConfig):
        raise ValueError(f"expected a model with the backbone 'swin', found {config.backbone.kind!r}")
    return {name: leaf.shape for name, leaf in weight_shapes(config).items() if not name.startswith("place_head/")}


def _flax_layout(name: str, weight: np.ndarray, shape: tuple[int, ...], source: str) -> np.ndarray:
    """Convert a kernel from PyTorch's axes (out, in, ...) to Flax's (..., in, out), of `shape`. Other weights stay.

    Raises ValueError, which names the weight `source` of the checkpoint, if it has another number of axes.
    """
    axes = 4 if name == "segmentation_head/kernel" else len(shape)
    if weight.ndim != axes:
        raise ValueError(f"{source}: expected {axes} axes (in Flax's order {shape}), found shape {weight.shape}")
    if name == "backbone/patch_embed/projection/kernel":
        weight = weight.sum(1, keepdims=True)  # three equal colours become one channel
    if name == "segmentation_head/kernel":
        weight = weight[..., 0, 0]  # a 1 x 1 convolution becomes a linear layer
    if not name.endswith("kernel"):
        return weight
    return weight.transpose(*range(2, weight.ndim), 1, 0)
