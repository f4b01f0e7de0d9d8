"""One training step: a pure function of state and batch.

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
from jaxtyping import Array

from sglpr_jax.data.sampling.batch import Batch, views
from sglpr_jax.labels import UNLABELLED
from sglpr_jax.models.input_image import field_of_view
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import forward
from sglpr_jax.models.weights import learning_segmentation_alone
from sglpr_jax.training.config import LossConfig, TrainConfig
from sglpr_jax.training.devices import keep_replicated, keep_split, on_own_rows
from sglpr_jax.training.loss import Metrics, Summary, joint_loss, segmentation_sums
from sglpr_jax.training.occlusion import visible
from sglpr_jax.training.optimizer import optimizer
from sglpr_jax.training.place_order import in_network_order
from sglpr_jax.training.state import TrainState


class Chunk(NamedTuple):
    """Images (c, h, w), their label maps (c, h, w) if there are labels, a mask of labelled images (c,), and a key
    ()."""

    images: Any
    maps: Any
    labelled: Any
    key: Any


@functools.partial(jax.jit, static_argnames="config", donate_argnames="state")
def train_step(state: TrainState, batch: Batch, *, config: TrainConfig) -> tuple[TrainState, Metrics]:
    """Make one step. The metrics are the loss, its terms, and the norms of gradient, update and weights."""
    angle_key, model_key = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), state.step))
    chunks = _chunks(batch, angle_key, model_key, config)
    gradient, metrics = gradients(state.params, chunks, batch, config.loss)
    updates, optimizer_state = optimizer(config.optimizer).update(gradient, state.optimizer, state.params.weights)
    weights = optax.apply_updates(state.params.weights, updates)
    norms = {"gradient_norm": gradient, "update_norm": updates, "weight_norm": weights}
    metrics |= {name: optax.tree.norm(tree) for name, tree in norms.items()}
    state = TrainState(state.step + 1, dataclasses.replace(state.params, weights=weights), optimizer_state)
    return keep_replicated(state), metrics


def gradients(params: Params, chunks: Chunk, batch: Batch, config: LossConfig) -> tuple[Any, Metrics]:
    """Return the gradient of equation 8 at `params.weights`, accumulated over the chunks, and the metrics of the loss.

    Arrays of `chunks` have a leading chunk axis.
    """

    def summary(weights, chunk: Chunk) -> Summary:
        return summarize(dataclasses.replace(params, weights=weights), chunk, config)

    def loss(summaries: Summary):
        return joint_loss(_merge(summaries), batch, config)

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
    params = learning_segmentation_alone(params) if config.segmentation_alone else params
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
    see = functools.partial(views, grid=config.model.grid)
    images, maps = (see if batch.also is not None else on_own_rows(see))(
        batch, angles
    )  # a mixed batch is on one device
    seen = field_of_view(config.model)
    if config.occlusion.share:
        key = jax.random.fold_in(angle_key, 1)
        shown = visible(key, config.images, config.model.grid, config.occlusion)
        seen, images = seen & shown, jnp.where(shown, images, 0)
    maps = None if maps is None else jnp.where(seen, maps, UNLABELLED)
    keys = jax.random.split(model_key, config.images // config.images_at_once)
    whole = (images, maps, jnp.asarray(batch.labelled))
    whole = jax.tree.map(lambda x: in_network_order(x, batch, every=config.loss.segment_every), whole)
    cut = jax.tree.map(lambda x: x.reshape(-1, config.images_at_once, *x.shape[1:]), whole)
    return Chunk(*keep_split(cut, axis=1), key=keys)  # otherwise each chunk would be on one device


def _angles(key: Array, config: TrainConfig) -> Array:
    """Return the rotation of each place, in radians."""
    angles = jax.random.uniform(key, (config.images,), maxval=2 * jnp.pi)
    if not config.quarter_turns:
        return angles
    by_quarters = jax.random.bernoulli(jax.random.fold_in(key, 3), config.quarter_turns, angles.shape)
    return jnp.where(by_quarters, jnp.floor(angles / (jnp.pi / 2)) * (jnp.pi / 2), angles)


def _merge(summaries: Summary) -> Summary:
    """Merge the summaries of all chunks: concatenate descriptors, add sums."""
    descriptors, sums = summaries
    return Summary(descriptors.reshape(-1, descriptors.shape[-1]), jax.tree.map(lambda s: s.sum(0), sums))
