"""A model that compiles fast, with random weights, and batches for it made in memory."""

import dataclasses
from collections.abc import Callable

import jax
import numpy as np
import pytest

from sglpr_jax.grid import Grid
from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.models.backbone_config import CircularConfig, SglprConfig, SwinConfig
from sglpr_jax.models.config import HeadConfig, model_preset
from sglpr_jax.models.weights import Params
from sglpr_jax.training.batch_source import TupleBatches
from sglpr_jax.training.batches import Batch
from sglpr_jax.training.config import OptimizerConfig, TrainConfig
from sglpr_jax.training.step import train_step

POINTS = 200
FAST_COMPILE = {"xla_backend_optimization_level": 0}
FAST_STEP = jax.jit(
    train_step.__wrapped__, static_argnames="network", donate_argnames="state", compiler_options=FAST_COMPILE
)
"""The real step, compiled in a third of the time."""


class Made(TupleBatches):
    """Batches that a function of the step makes."""

    def __init__(self, make: Callable[[int], Batch], *, scan_names: Callable[[int], str] = lambda step: ""):
        self._make, self.scan_names = make, scan_names

    def batch(self, step: int) -> Batch:
        return self._make(step)


MODEL = dataclasses.replace(
    model_preset("tiny"),
    grid=Grid(resolution_m=3.2, height=16, width=16),
    field="circle",
    polar=(8, 16),
    backbone=SglprConfig(stem=CircularConfig(widths=(4,), strides=(1,), means=(1,), fine=()), depths=(), heads=()),
    head=HeadConfig(tap="tokens", cbam=False, channels=(), kernels=(), strides=(), clusters=4, descriptor_size=16),
)
"""A step of it compiles in half the time of one with attention."""
SWIN = dataclasses.replace(
    MODEL,
    field="square",
    polar=None,
    backbone=SwinConfig(embed_dim=8, depths=(2,), heads=(2,), window=4, drop_path=0.3),
    head=HeadConfig(channels=(16,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=4, descriptor_size=16),
)
"""With stochastic depth, attention and the whole place head."""


@pytest.fixture(scope="session")
def config() -> TrainConfig:
    """Two tuples of four places, the whole batch at once."""
    return TrainConfig(
        model=MODEL,
        sampling=TupleConfig(positives=1, negatives=2),
        optimizer=OptimizerConfig(learning_rate=3e-3),
        steps=6,
        tuples=2,
        max_points=POINTS,
        log_every=1,
        score_every=2,
    )


@pytest.fixture(scope="session")
def params(config, random_params) -> Params:
    """Ready-made weights of that model."""
    return random_params(config.model)


@pytest.fixture(scope="session")
def make_batch(config):
    """The batch of a step: clouds that differ from place to place, each with a class per point, or images."""

    def make(step: int, *, labels: bool = True, images: bool = False) -> Batch:
        rng = np.random.default_rng([7, step])
        b, grid = config.images, config.model.grid
        far = np.kron(np.eye(config.tuples, dtype=bool), np.array([False, False, True, True]))
        if images:
            pictures = rng.poisson(0.5, (b, grid.height, grid.width)).astype(np.float32)
            return Batch(np.zeros(b, bool), far, 1, images=pictures)
        return Batch(
            labelled=np.arange(b) % 3 != 0 if labels else np.zeros(b, bool),
            negatives=far,
            positives=1,
            points=rng.normal(scale=10, size=(b, POINTS, 3)).astype(np.float32),
            count=rng.integers(POINTS // 2, POINTS, b).astype(np.int32),
            classes=rng.integers(0, 20, (b, POINTS)).astype(np.int32) if labels else None,
        )

    return make
