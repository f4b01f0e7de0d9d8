"""Named model sizes, so that `init(key, preset="small")` works wherever the package is installed."""

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
    # The paper's model, its head read literally: three 3 x 3 convolutions of stride 2 on 224 x 224 x 96.
    "paper": _PAPER,
    # A third of that head's cost: the first convolution undoes the x4 expansion in one step.
    "paper-head-b": dataclasses.replace(_PAPER, head=HeadConfig(kernels=(4, 3, 3), strides=(4, 2, 2))),
    # The paper says "projection radius 11.2 m", which its own eq. 1 gives only with cells of 0.1 m.
    "paper-11m": dataclasses.replace(_PAPER, grid=Grid(resolution_m=0.1)),
    # Every stage of the paper's Swin-Unet and its window, from cells of 0.4 m: it reads the ready-made KITTI images.
    "paper-112": dataclasses.replace(
        _PAPER, grid=Grid(resolution_m=0.4, height=112, width=112), image="density", backbone=SwinConfig(patch=2)
    ),
    # Trains on two CPU cores within the hour; its window is that of the ready-made KITTI images (+-25.6 m).
    "small": _SMALL,
    # With convolutions in front, which learn the semantic map better (docs/results.md); a step takes longer.
    "small-stem": dataclasses.replace(_SMALL, backbone=dataclasses.replace(_SMALL_SWIN, stem=(16, 32, 64))),
    # A convolutional backbone that a rotation of the scan only shifts.
    "rings": dataclasses.replace(
        _SMALL,
        image="density",
        backbone=RingConfig(),
        head=HeadConfig(tap="tokens", cbam=False, channels=(), kernels=(), strides=()),
    ),
    # The paper's parts in a form that follows a rotation: circular convolutions, then windows, CBAM, NetVLAD.
    "sglpr": dataclasses.replace(
        _SMALL,
        image="density",
        backbone=SglprConfig(),
        head=HeadConfig(tap="tokens", channels=(96, 128, 160), strides=(2, 1, 1), means=(1, 2, 1)),
    ),
    # For tests: every part of the model, next to no arithmetic.
    "tiny": ModelConfig(
        grid=Grid(resolution_m=1.6, height=32, width=32),
        backbone=SwinConfig(embed_dim=8, depths=(1, 1), heads=(1, 2), window=4, drop_path=0.1),
        head=HeadConfig(channels=(8, 8, 16), kernels=(4, 3, 3), strides=(4, 2, 1), clusters=4),
    ),
}


def model_preset(name: str) -> ModelConfig:
    """The model of that name. Raises ValueError with the names there are."""
    if name not in MODELS:
        raise ValueError(f"no model preset {name!r}; there are {', '.join(MODELS)}")
    return MODELS[name]
