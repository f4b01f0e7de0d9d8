"""Named model configurations, so that `init(key, preset="circular")` works wherever the package is installed."""

import dataclasses

from sglpr_jax.grid import Grid
from sglpr_jax.models.backbones.circular_config import CircularConfig
from sglpr_jax.models.backbones.sglpr_config import SglprConfig
from sglpr_jax.models.backbones.swin_config import SwinConfig
from sglpr_jax.models.config import HeadConfig, ModelConfig

_PAPER = ModelConfig()
_POLAR = ModelConfig(
    grid=Grid(resolution_m=0.4, height=128, width=128),
    image="density",
    field="circle",
    blind_m=2.6,
    range_channel=True,
    polar=(64, 256),
    backbone=SglprConfig(),
    head=HeadConfig(tap="tokens", channels=(96, 128, 160), strides=(2, 1, 1), means=(1, 2, 1)),
    detail=32,
)

MODELS: dict[str, ModelConfig] = {
    # The default: the paper's parts in a form that follows rotations. Circular convolutions, then windows, CBAM and
    # NetVLAD, on polar images of the window of the ready-made KITTI images (+-25.6 m).
    "sglpr": _POLAR,
    # A circular CNN with NetVLAD: less computation, without CBAM and attention.
    "circular": dataclasses.replace(
        _POLAR,
        backbone=CircularConfig(),
        head=HeadConfig(tap="tokens", cbam=False, channels=(), kernels=(), strides=()),
    ),
    # The paper's model with a literal head: three 3 x 3 convolutions of stride 2 on 224 x 224 x 96.
    "paper": _PAPER,
    # All stages of the paper's Swin-Unet and its window, with cells of 0.4 m as in the ready-made KITTI images.
    "paper-112": dataclasses.replace(
        _PAPER, grid=Grid(resolution_m=0.4, height=112, width=112), image="density", backbone=SwinConfig(patch=2)
    ),
    # For tests: every part of the model, with little computation.
    "tiny": ModelConfig(
        grid=Grid(resolution_m=1.6, height=32, width=32),
        backbone=SwinConfig(embed_dim=8, depths=(1, 1), heads=(1, 2), window=4, drop_path=0.1),
        head=HeadConfig(channels=(8, 8, 16), kernels=(4, 3, 3), strides=(4, 2, 1), clusters=4),
    ),
}


def model_preset(name: str) -> ModelConfig:
    """Return the model configuration with this name.

    Raises:
      ValueError: If there is no preset with this name. The message lists all names.
    """
    if name not in MODELS:
        raise ValueError(f"expected a model preset ({', '.join(MODELS)}), found {name!r}")
    return MODELS[name]
