"""The preset `tiny` with a still smaller model, for tests of whole trainings."""

import dataclasses

from sglpr_jax.grid import Grid
from sglpr_jax.models.backbone_config import SwinConfig
from sglpr_jax.models.config import HeadConfig
from sglpr_jax.training.presets import load_preset

TINY = load_preset("tiny")
MODEL = dataclasses.replace(
    TINY.model,
    grid=Grid(resolution_m=3.2, height=16, width=16),
    backbone=SwinConfig(embed_dim=8, depths=(1,), heads=(2,), window=4, drop_path=0.1),
    head=HeadConfig(channels=(16,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=4),
)
CONFIG = dataclasses.replace(TINY, model=MODEL)
