"""The network of this package in a run of `bin/train`: what a step sees, its loss and its gradient.

The triplet and Dice losses span the batch, so the gradient of a chunk depends on all other chunks. A step in chunks
therefore has two passes. The first computes the inputs of the losses: descriptors and a few sums per chunk. The second
runs each chunk forward and backward with the gradients of the losses at these inputs. Only the activations of one chunk
are in memory at a time.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool

from sglpr_jax.grid import Grid
from sglpr_jax.labels import UNLABELLED
from sglpr_jax.models.input_image import field_of_view
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import forward, init
from sglpr_jax.models.weights import freeze_descriptor_layers
from sglpr_jax.training.batches import Batch, in_network_order, views
from sglpr_jax.training.config import LossConfig, OcclusionConfig, TrainConfig
from sglpr_jax.training.devices import keep_placed, on_own_rows
from sglpr_jax.training.loss_terms import Summary, joint_loss, segmentation_sums
from sglpr_jax.training.step import Gradient, Metrics, TrainState


@dataclasses.dataclass(frozen=True)
class ImageNetwork:
    """A `PlaceNetwork` (`training.step`) with the model, the loss and the optimiser of a configuration."""

    config: TrainConfig

    @property
    def seed(self) -> int:
        """Seed of the weights and of the random choices of a step."""
        return self.config.seed

    @property
    def images(self) -> int:
        """Images per step."""
        return self.config.images

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Adam with linear warm-up and exponential decay of the learning rate (section 5.1.2)."""
        config = self.config.optimizer
        schedule = optax.warmup_exponential_decay_schedule(
            init_value=config.learning_rate if config.warmup_steps == 0 else 0.0,
            peak_value=config.learning_rate,
            warmup_steps=config.warmup_steps,
            transition_steps=config.decay_steps,
            decay_rate=config.decay_rate,
            staircase=config.staircase,
        )
        clip = optax.identity() if config.clip_norm is None else optax.clip_by_global_norm(config.clip_norm)
        return optax.chain(clip, optax.adamw(schedule, weight_decay=config.weight_decay))

    def new_state(self, params: Params | None = None) -> TrainState:
        """Return the state before the first step, with these weights or random ones."""
        weights: Any = params
        if params is None:
            weights = init(jax.random.key(self.config.seed), config=self.config.model)
        return TrainState(jnp.zeros((), jnp.int32), weights, self.optimizer.init(weights))

    def gradient(self, state: TrainState, batch: Batch, key: Array) -> Gradient:
        """Return the gradient of equation 8 for the rotated batch, and the metrics of the loss."""
        angle_key, model_key = jax.random.split(key)
        chunks = _chunks(batch, angle_key, model_key, self.config)
        weights, metrics = gradients(state.params, chunks, batch, self.config.loss)
        return Gradient(dataclasses.replace(state.params, weights=weights), {}, metrics)


class Chunk(NamedTuple):
    """Images (c, h, w), their label maps (c, h, w) if there are labels, a mask of labelled images (c,), and a key
    ()."""

    images: Any
    maps: Any
    labelled: Any
    key: Any


def gradients(params: Params, chunks: Chunk, batch: Batch, config: LossConfig) -> tuple[Any, Metrics]:
    """Return the gradient of equation 8 at `params.weights`, accumulated over the chunks, and the metrics of the loss.

    Arrays of `chunks` have a leading chunk axis.
    """

    def summary(weights, chunk: Chunk) -> Summary:
        return summarize(dataclasses.replace(params, weights=weights), chunk, config)

    def loss(summaries: Summary):
        descriptors, sums = summaries
        merged = Summary(descriptors.reshape(-1, descriptors.shape[-1]), jax.tree.map(lambda s: s.sum(0), sums))
        return joint_loss(merged, batch, config)

    if chunks.images.shape[0] == 1:
        only = jax.tree.map(lambda x: x[0], chunks)
        return jax.grad(lambda w: loss(jax.tree.map(lambda x: x[None], summary(w, only))), has_aux=True)(params.weights)

    summaries = jax.lax.map(lambda chunk: summary(params.weights, chunk), chunks)
    cotangents, metrics = jax.grad(loss, has_aux=True)(summaries)

    def add(total, chunk_and_cotangent):
        chunk, cotangent = chunk_and_cotangent
        (gradient,) = jax.vjp(lambda w: summary(w, chunk), params.weights)[1](cotangent)
        return jax.tree.map(jnp.add, total, gradient), None

    zeros = jax.tree.map(jnp.zeros_like, params.weights)
    return jax.lax.scan(add, zeros, (chunks, cotangents))[0], metrics


def summarize(params: Params, chunk: Chunk, config: LossConfig) -> Summary:
    """Run one chunk through the network. The segmentation head runs only if there are labels, on every n-th image."""
    params = freeze_descriptor_layers(params) if config.segmentation_alone else params
    labels = chunk.maps if params.config.head.reads_labels else None
    if chunk.maps is None or not (params.config.segments and config.segments):
        return Summary(forward(params, chunk.images, labels, key=chunk.key, segment=0).descriptor, {})
    outputs = forward(params, chunk.images, key=chunk.key, segment=config.segment_every)
    maps, labelled = (x[:: config.segment_every] for x in (chunk.maps, chunk.labelled))
    counted = labelled[:, None, None] & ((maps != UNLABELLED) | (not config.ignore_unlabelled))
    return Summary(outputs.descriptor, segmentation_sums(outputs.logits, maps, counted, config))


def _chunks(batch: Batch, angle_key: Array, model_key: Array, config: TrainConfig) -> Chunk:
    """Return the batch as the network sees it, cut into chunks along a new leading axis."""
    angles = _angles(angle_key, config) if config.rotate else None
    make_views = functools.partial(views, grid=config.model.grid)
    make_views = make_views if batch.second is not None else on_own_rows(make_views)  # a mixed batch is on one device
    images, maps = make_views(batch, angles)
    visible_cells = field_of_view(config.model)
    if config.occlusion.share:
        key = jax.random.fold_in(angle_key, 1)
        unoccluded = visible(key, config.images, config.model.grid, config.occlusion)
        visible_cells, images = visible_cells & unoccluded, jnp.where(unoccluded, images, 0)
    maps = None if maps is None else jnp.where(visible_cells, maps, UNLABELLED)
    keys = jax.random.split(model_key, config.images // config.images_at_once)

    def cut(x: Array) -> Array:
        ordered = in_network_order(x, batch, every=config.loss.segment_every)
        return ordered.reshape(-1, config.images_at_once, *x.shape[1:])

    chunks = jax.tree.map(cut, (images, maps, jnp.asarray(batch.labelled)))
    return Chunk(*keep_placed(chunks, axis=1), key=keys)  # otherwise each chunk would be on one device


def _angles(key: Array, config: TrainConfig) -> Array:
    """Return the rotation of each place, in radians."""
    angles = jax.random.uniform(key, (config.images,), maxval=2 * jnp.pi)
    if not config.quarter_turns:
        return angles
    by_quarters = jax.random.bernoulli(jax.random.fold_in(key, 3), config.quarter_turns, angles.shape)
    return jnp.where(by_quarters, jnp.floor(angles / (jnp.pi / 2)) * (jnp.pi / 2), angles)


def visible(key: Array, images: int, grid: Grid, config: OcclusionConfig) -> Bool[Array, "b h w"]:
    """Return the visible cells of each image. In a fraction of the images, a random sector is hidden.

    The width of the sector is uniform between 0 and `config.widest_deg`. The bearing of a cell is that of its centre.
    """
    chosen_key, width_key, start_key = jax.random.split(key, 3)
    chosen = jax.random.bernoulli(chosen_key, config.share, (images,))
    width = jnp.where(chosen, jax.random.uniform(width_key, (images,), maxval=jnp.deg2rad(config.widest_deg)), 0.0)
    start = jax.random.uniform(start_key, (images,), maxval=2 * jnp.pi)
    x, y = jnp.meshgrid(jnp.arange(grid.height) + 0.5, jnp.arange(grid.width) + 0.5, indexing="ij")
    bearing = jnp.arctan2(y - grid.width / 2, x - grid.height / 2)
    return (bearing[None] - start[:, None, None]) % (2 * jnp.pi) >= width[:, None, None]
