"""Named model configurations, so that `init(key, preset="small")` works wherever the package is installed."""

import dataclasses

from sglpr_jax.grid import Grid
from sglpr_jax.models.backbones.rings_config import RingConfig
from sglpr_jax.models.backbones.sglpr_config import SglprConfig
from sglpr_jax.models.backbones.swin_config import SwinConfig
from sglpr_jax.models.config import HeadConfig, ModelConfig

_PAPER = ModelConfig()
_SMALL_SWIN = SwinConfig(patch=8, embed_dim=64, depths=(2, 2, 2), heads=(2, 4, 8), window=4, drop_path=0.0)
_SMALL = ModelConfig(
    grid=Grid(resolution_m=0.4, height=128, width=128),
    field="circle",
    blind_m=2.6,
    range_channel=True,
    polar=(64, 256),
    backbone=_SMALL_SWIN,
    head=HeadConfig(tap="tokens", channels=(64, 128, 256), kernels=(3, 3, 3), strides=(1, 1, 2)),
    detail=32,
)

MODELS: dict[str, ModelConfig] = {
    # The paper's model with a literal head: three 3 x 3 convolutions of stride 2 on 224 x 224 x 96.
    "paper": _PAPER,
    # A head of a third of the cost: its first convolution reverses the x4 expansion in one step.
    "paper-head-b": dataclasses.replace(_PAPER, head=HeadConfig(kernels=(4, 3, 3), strides=(4, 2, 2))),
    # The paper says "projection radius 11.2 m". Its equation 1 gives this radius only with cells of 0.1 m.
    "paper-11m": dataclasses.replace(_PAPER, grid=Grid(resolution_m=0.1)),
    # All stages of the paper's Swin-Unet and its window, with cells of 0.4 m as in the ready-made KITTI images.
    "paper-112": dataclasses.replace(
        _PAPER, grid=Grid(resolution_m=0.4, height=112, width=112), image="density", backbone=SwinConfig(patch=2)
    ),
    # Trains in less than an hour on two CPU cores. Its window is that of the ready-made KITTI images (+-25.6 m).
    "small": _SMALL,
    # Has convolutions in front, which improve the semantic map (docs/results.md). A step takes longer.
    "small-stem": dataclasses.replace(_SMALL, backbone=dataclasses.replace(_SMALL_SWIN, stem=(16, 32, 64))),
    # Convolutional backbone whose features shift when the scan is rotated.
    "rings": dataclasses.replace(
        _SMALL,
        image="density",
        backbone=RingConfig(),
        head=HeadConfig(tap="tokens", cbam=False, channels=(), kernels=(), strides=()),
    ),
    # The paper's parts in a form that follows rotations: circular convolutions, then windows, CBAM and NetVLAD.
    "sglpr": dataclasses.replace(
        _SMALL,
        image="density",
        backbone=SglprConfig(),
        head=HeadConfig(tap="tokens", channels=(96, 128, 160), strides=(2, 1, 1), means=(1, 2, 1)),
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
