"""Training of the network of this package: input images of a step, in chunks to save memory, loss and gradient."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
import optax.contrib
from jaxtyping import Array, Bool, Float

from sglpr_jax.grid import Grid
from sglpr_jax.labels import UNLABELLED
from sglpr_jax.models.input_image import field_of_view
from sglpr_jax.models.sglpr import describe, forward, init
from sglpr_jax.models.weights import Params, freeze_descriptor_layers
from sglpr_jax.models.weights_file import load
from sglpr_jax.training.batches import Batch, in_batch_order, in_network_order, views
from sglpr_jax.training.config import LossConfig, OcclusionConfig, TrainConfig
from sglpr_jax.training.devices import keep_sharding, per_device
from sglpr_jax.training.loss_terms import Summary, joint_loss, segmentation_sums
from sglpr_jax.training.step import Gradient, Metrics, TrainState

VECTOR_RATE = 1 / 10
"""Learning rate of vectors, as a fraction of that of matrices."""


@dataclasses.dataclass(frozen=True)
class ImageNetwork:
    """A `PlaceNetwork` (`training.step`) with the model, the loss and the optimiser of a configuration."""

    config: TrainConfig

    @property
    def seed(self) -> int:
        return self.config.seed

    @property
    def images(self) -> int:
        return self.config.images

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Adam (section 5.1.2) or Muon, with linear warm-up and exponential decay of the learning rate."""
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
        if config.algorithm == "adam":
            # Adam. The state of `optax.adam` differs from that in older checkpoints.
            return optax.chain(clip, optax.adamw(schedule, weight_decay=0.0))
        muon = optax.contrib.muon(
            schedule,
            adam_learning_rate=lambda step: VECTOR_RATE * schedule(step),
            muon_weight_dimension_numbers=_matrices,
        )
        return optax.chain(clip, muon)

    def new_state(self, params: Params | None = None) -> TrainState:
        """Return the state before the first step, with these weights or random ones."""
        weights: Any = params
        if params is None:
            weights = init(jax.random.key(self.config.seed), config=self.config.model)
        return TrainState(jnp.zeros((), jnp.int32), weights, self.optimizer.init(weights))

    def gradient(self, state: TrainState, batch: Batch, key: Array) -> Gradient:
        """Return the gradient of the joint loss (equation 8) for the rotated batch, and the metrics of the loss."""
        angle_key, model_key = jax.random.split(key)
        chunks = _network_input(batch, angle_key, model_key, self.config)
        if self.config.loss.teacher:
            batch = dataclasses.replace(batch, teacher=_teacher_descriptors(batch, chunks, self.config.loss))
        gradient, metrics = gradients(state.params, chunks, batch, self.config.loss)
        return Gradient(dataclasses.replace(state.params, weights=gradient), {}, metrics)


def _matrices(weights: Any) -> Any:
    """Return the axes of each weight as a matrix for Muon: all inputs, and the outputs. None for a vector."""

    def axes(weight: Array) -> optax.contrib.MuonDimensionNumbers | None:
        *inputs, output = range(weight.ndim)
        return optax.contrib.MuonDimensionNumbers(tuple(inputs), output) if inputs else None

    return jax.tree.map(axes, weights)


class Chunk(NamedTuple):
    """Images that pass through the network at a time. `key` draws the branches that stochastic depth drops."""

    images: Any  # (c, h, w)
    maps: Any  # class of every pixel (c, h, w), or None without labels
    labelled: Any  # whether each image has labels (c,)
    key: Any


def gradients(params: Params, chunks: Chunk, batch: Batch, config: LossConfig) -> tuple[Any, Metrics]:
    """Return the gradient of the joint loss (equation 8) at `params.weights`, and the metrics of the loss.

    Arrays of `chunks` have a leading chunk axis. The triplet and Dice losses span the batch, so the gradient of a chunk
    depends on all other chunks. The first pass computes the inputs of the loss: descriptors and a few sums per chunk.
    The second pass runs each chunk forward and backward with the gradient of the loss at these inputs, so only the
    activations of one chunk are in memory at a time. A single chunk needs one pass.
    """

    def summary_of(weights, chunk: Chunk) -> Summary:
        return summarize(dataclasses.replace(params, weights=weights), chunk, config)

    def loss_of(summaries: Summary):
        descriptors, sums = summaries
        all_sums = jax.tree.map(lambda chunk_sums: chunk_sums.sum(0), sums)
        return joint_loss(Summary(descriptors.reshape(-1, descriptors.shape[-1]), all_sums), batch, config)

    if chunks.images.shape[0] == 1:
        chunk = jax.tree.map(lambda x: x[0], chunks)

        def loss_of_weights(weights):
            return loss_of(jax.tree.map(lambda x: x[None], summary_of(weights, chunk)))

        return jax.grad(loss_of_weights, has_aux=True)(params.weights)

    summaries = jax.lax.map(lambda chunk: summary_of(params.weights, chunk), chunks)
    summary_gradients, metrics = jax.grad(loss_of, has_aux=True)(summaries)

    def add_gradient(total, chunk_and_summary_gradient):
        chunk, summary_gradient = chunk_and_summary_gradient
        _, backward = jax.vjp(lambda weights: summary_of(weights, chunk), params.weights)
        (gradient,) = backward(summary_gradient)
        return jax.tree.map(jnp.add, total, gradient), None

    zeros = jax.tree.map(jnp.zeros_like, params.weights)
    return jax.lax.scan(add_gradient, zeros, (chunks, summary_gradients))[0], metrics


def summarize(params: Params, chunk: Chunk, config: LossConfig) -> Summary:
    """Run a chunk through the network. Returns its descriptors and, with labels, its sums for the segmentation losses.

    The segmentation head runs on every `config.segment_every`-th image.
    """
    params = freeze_descriptor_layers(params) if config.segmentation_alone else params
    if chunk.maps is None or not (params.config.segments and config.segments):
        labels = chunk.maps if params.config.head.reads_labels else None
        return Summary(forward(params, chunk.images, labels, key=chunk.key, segment=0).descriptor, {})
    outputs = forward(params, chunk.images, key=chunk.key, segment=config.segment_every)
    maps = chunk.maps[:: config.segment_every]
    labelled_images = chunk.labelled[:: config.segment_every, None, None]
    counted_pixels = labelled_images & ((maps != UNLABELLED) | (not config.ignore_unlabelled))
    return Summary(outputs.descriptor, segmentation_sums(outputs.logits, maps, counted_pixels, config))


def _network_input(batch: Batch, angle_key: Array, model_key: Array, config: TrainConfig) -> Chunk:
    """Rasterise, rotate and occlude the places of a batch, and cut them into chunks along a new leading axis."""
    angles = _random_angles(angle_key, config) if config.rotate else None
    make_views = functools.partial(views, grid=config.model.grid)
    if batch.second is None:  # a batch of two datasets is on one device
        make_views = per_device(make_views)
    images, maps = make_views(batch, angles)
    visible_cells = field_of_view(config.model)
    if config.occlusion.share:
        key = jax.random.fold_in(angle_key, 1)
        unoccluded = unoccluded_cells(key, config.images, config.model.grid, config.occlusion)
        visible_cells = visible_cells & unoccluded
        images = jnp.where(unoccluded, images, 0)
    maps = None if maps is None else jnp.where(visible_cells, maps, UNLABELLED)
    keys = jax.random.split(model_key, config.images // config.images_at_once)

    def cut_into_chunks(x: Array) -> Array:
        ordered = in_network_order(x, batch, every=config.loss.segment_every)
        return ordered.reshape(-1, config.images_at_once, *x.shape[1:])

    chunks = jax.tree.map(cut_into_chunks, (images, maps, jnp.asarray(batch.labelled)))
    return Chunk(*keep_sharding(chunks, axis=1), key=keys)  # without it, each chunk would be on one device


def _teacher_descriptors(batch: Batch, chunks: Chunk, config: LossConfig) -> Float[Array, "b d"]:
    """Return the descriptors of the teacher for the images of all chunks, in the order of the batch."""
    assert config.teacher is not None
    teacher = load(config.teacher)
    descriptors = jax.lax.map(lambda images: describe(teacher, images), chunks.images)
    return in_batch_order(descriptors.reshape(-1, descriptors.shape[-1]), batch, every=config.segment_every)


def _random_angles(key: Array, config: TrainConfig) -> Array:
    """Return a random rotation of each place in radians. A share `config.quarter_turns` are multiples of 90 degrees."""
    angles = jax.random.uniform(key, (config.images,), maxval=2 * jnp.pi)
    if not config.quarter_turns:
        return angles
    is_quarter_turn = jax.random.bernoulli(jax.random.fold_in(key, 3), config.quarter_turns, angles.shape)
    return jnp.where(is_quarter_turn, jnp.floor(angles / (jnp.pi / 2)) * (jnp.pi / 2), angles)


def unoccluded_cells(key: Array, images: int, grid: Grid, config: OcclusionConfig) -> Bool[Array, "b h w"]:
    """Return a mask of the visible cells of each image. In a random fraction of the images, a sector is hidden.

    The width of the sector is uniform from 0 to `config.widest_deg`. A cell is hidden if its centre is.
    """
    occluded_key, width_key, start_key = jax.random.split(key, 3)
    is_occluded = jax.random.bernoulli(occluded_key, config.share, (images,))
    widths = jax.random.uniform(width_key, (images,), maxval=jnp.deg2rad(config.widest_deg))
    width = jnp.where(is_occluded, widths, 0.0)[:, None, None]
    start = jax.random.uniform(start_key, (images,), maxval=2 * jnp.pi)[:, None, None]
    x, y = jnp.meshgrid(jnp.arange(grid.height) + 0.5, jnp.arange(grid.width) + 0.5, indexing="ij")
    azimuth = jnp.arctan2(y - grid.width / 2, x - grid.height / 2)[None]
    return (azimuth - start) % (2 * jnp.pi) >= width
