"""Inputs of the speed benchmarks: the model of a preset, random weights, random scans and batches."""

import dataclasses

import jax
import numpy as np

from sglpr_jax.grid import DENSITY_SIZE, Grid, ImageKind
from sglpr_jax.models.config import ModelConfig, model_preset
from sglpr_jax.models.sglpr import init
from sglpr_jax.models.weights import Params
from sglpr_jax.training.batches import Batch
from sglpr_jax.training.config import TrainConfig

CLOUD_SPREAD = 0.29
"""Standard deviation of x and y as a fraction of the window's width: 84 % of the points are inside."""

MEAN_COUNT = 0.3
"""Mean count of the cells of a random image. A quarter of the cells is not empty."""

WEIGHT_NOISE = 0.01
"""Standard deviation of noise on initial weights. Many are 0 or 1, which would hide that two were exchanged."""


def comparable_model(preset: str, *, labels: bool = True) -> ModelConfig:
    """Model of a preset without the parts that differ between frameworks.

    Stochastic depth is off because it is random, and there is no whitening. Input images are images of counts.
    Without `labels`, there is no segmentation head.
    """
    config = model_preset(preset)
    backbone = dataclasses.replace(config.backbone, drop_path=0.0)
    categories, head = config.categories if labels else 0, dataclasses.replace(config.head, whiten=False)
    return dataclasses.replace(config, image="points", backbone=backbone, head=head, categories=categories)


def random_params(config: ModelConfig) -> Params:
    """Weights as numpy arrays, none of them at a value that many others have."""
    rng = np.random.default_rng(0)
    params = jax.device_get(init(jax.random.key(0), config=config))
    return jax.tree.map(lambda w: w + WEIGHT_NOISE * rng.standard_normal(w.shape, np.float32), params)


def random_scans(*shape: int, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Clouds (*shape, 3), denser near the sensor, and the class of each point (*shape)."""
    rng = np.random.default_rng(0)
    spread = CLOUD_SPREAD * grid.resolution_m * np.array([grid.width, grid.height, 0.0]) + [0, 0, 1]
    points = spread * rng.standard_normal((*shape, 3))
    return points.astype(np.float32), rng.integers(1, 20, shape, dtype=np.int32)


def random_images(number: int, grid: Grid, *, image: ImageKind) -> tuple[np.ndarray, np.ndarray]:
    """Images of counts (number, h, w) in the size of `grid`, or of ready-made density images, and their classes."""
    rng = np.random.default_rng(0)
    shape = (number, *((DENSITY_SIZE, DENSITY_SIZE) if image == "density" else (grid.height, grid.width)))
    counts = rng.poisson(MEAN_COUNT, shape).clip(max=10)
    return counts.astype(np.float32), (rng.integers(1, 20, shape) * (counts > 0)).astype(np.int32)


def random_batch(config: TrainConfig, points: int, *, labels: bool = True) -> Batch:
    """Random batch of a training step: clouds of `points` points, or images if `points` is 0.

    A model of density images always gets images, because a step does not rasterise them. All scans have labels or none.
    """
    positives, places = config.sampling.positives, config.images // config.tuples
    tuple_of, place_of = np.divmod(np.arange(config.images), places)
    own = tuple_of == np.arange(config.tuples)[:, None]
    far = np.where(own, place_of > positives, config.share_negatives)
    labelled = np.full(config.images, labels)
    if points == 0 or config.model.image == "density":
        images, maps = random_images(config.images, config.model.grid, image=config.model.image)
        return Batch(labelled, far, positives, images=images, maps=maps if labels else None)
    clouds, classes = random_scans(config.images, points, grid=config.model.grid)
    count = np.full(config.images, points, np.int32)
    return Batch(labelled, far, positives, points=clouds, count=count, classes=classes if labels else None)
