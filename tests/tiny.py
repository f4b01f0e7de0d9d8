"""A preset of a model that is next to no arithmetic, for programs and tests that need whole trainings in seconds."""

import dataclasses

from sglpr_jax.data.sampling.config import TupleConfig
from sglpr_jax.grid import Grid
from sglpr_jax.models.backbones.swin_config import SwinConfig
from sglpr_jax.models.config import HeadConfig
from sglpr_jax.models.presets import model_preset
from sglpr_jax.training.config import OptimizerConfig, TrainConfig

MODEL = dataclasses.replace(
    model_preset("tiny"),
    grid=Grid(resolution_m=3.2, height=16, width=16),
    backbone=SwinConfig(embed_dim=8, depths=(1,), heads=(2,), window=4, drop_path=0.1),
    head=HeadConfig(channels=(16,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=4),
)
CONFIG = TrainConfig(
    model=MODEL,
    sampling=TupleConfig(negatives=2, positive_m=16.0),
    optimizer=OptimizerConfig(learning_rate=1e-3),
    steps=4,
    tuples=2,
    max_points=512,
    log_every=1,
    score_every=2,
)
