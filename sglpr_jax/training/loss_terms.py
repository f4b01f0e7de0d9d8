"""The training loss: a table of terms with their weights.

A new term needs an entry in the table, its functions, and a field for its weight.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sglpr_jax import losses
from sglpr_jax.training.batches import Batch, in_batch_order, in_network_order
from sglpr_jax.training.config import LossConfig
from sglpr_jax.training.step import Metrics


@dataclasses.dataclass(frozen=True)
class DescriptorTerm:
    """Term of the loss that depends on the descriptors of a whole batch."""

    weight: Callable[[LossConfig], float]
    value: Callable[[Float[Array, "b d"], Batch, LossConfig], Float[Array, ""]]
    """`(descriptors, batch, config) -> value of the term`"""


@dataclasses.dataclass(frozen=True)
class SegmentationTerm:
    """Term of the loss that depends on class logits. Images come in chunks, and the sums of the chunks are added."""

    weight: Callable[[LossConfig], float]
    sums: Callable[[Float[Array, "c h w k"], Int[Array, "c h w"], Bool[Array, "c h w"], LossConfig], Array]
    """`(logits, classes, mask of the counted pixels, config) -> sums of one chunk`"""
    value: Callable[[Any, Int[Array, ""]], Float[Array, ""]]
    """`(sums of the batch, number of segmented images with labels) -> value of the term`"""


class Summary(NamedTuple):
    """Input of the loss from the images of a chunk or of a whole batch."""

    descriptors: Any
    """Descriptors (c, d)."""
    sums: dict[str, Any]
    """Sums of each segmentation term, by its name. Empty without labels."""


def triplet(descriptors: Float[Array, "b d"], batch: Batch, config: LossConfig) -> Float[Array, ""]:
    """Equation 5, averaged over the tuples of `batch.negatives`."""
    distances = _tuple_distances(descriptors, batch, config)
    options: dict[str, Any] = _options(batch, config) | {"temperature": config.temperature}
    loss = losses.lazy_triplet(*distances, **options).mean()
    if not config.one_threshold:
        return loss
    shared_threshold = losses.one_threshold(*distances, **options).mean()
    return (1 - config.one_threshold) * loss + config.one_threshold * shared_threshold


def violations(descriptors: Float[Array, "b d"], batch: Batch, config: LossConfig) -> Float[Array, ""]:
    """Return the fraction of tuples that violate the margin."""
    lazy = losses.lazy_triplet(*_tuple_distances(descriptors, batch, config), **_options(batch, config))
    return (lazy > 0).mean()  # without a temperature, because the smooth loss is never zero


DESCRIPTOR_TERMS = {"triplet": DescriptorTerm(lambda config: 0.0 if config.segmentation_alone else 1.0, triplet)}
SEGMENTATION_TERMS = {
    "cross_entropy": SegmentationTerm(  # equation 6, averaged over the labelled images
        weight=lambda config: config.ce_weight,
        sums=lambda logits, classes, counted, config: losses.cross_entropy(
            logits, classes, where=counted, balance=config.class_balance
        ).sum(),
        value=lambda total, images: total / jnp.maximum(images, 1),
    ),
    "dice": SegmentationTerm(  # equation 7 over the pixels of all labelled images; 0 without labelled images
        weight=lambda config: config.dice_weight,
        sums=lambda logits, classes, counted, config: losses.dice_sums(logits, classes, counted),
        value=lambda sums, images: jnp.where(images > 0, losses.dice_from_sums(sums), 0.0),
    ),
}
"""Equation 8 is the weighted sum of all terms. Metrics and learning curves use their names."""
TERM_NAMES = (*DESCRIPTOR_TERMS, *SEGMENTATION_TERMS)


def segmentation_sums(
    logits: Float[Array, "c h w k"], classes: Int[Array, "c h w"], counted: Bool[Array, "c h w"], config: LossConfig
) -> dict[str, Array]:
    """Return the sums of a chunk, over the `counted` pixels, for all segmentation terms with a nonzero weight."""
    terms = _weighted(SEGMENTATION_TERMS, config)
    return {name: term.sums(logits, classes, counted, config) for name, term in terms.items()}


def joint_loss(summary: Summary, batch: Batch, config: LossConfig) -> tuple[Float[Array, ""], Metrics]:
    """Compute equation 8 for a whole batch.

    Returns:
      The loss, and the metrics by name: its terms, the fraction of `violations` and the loss itself.
    """
    descriptors = in_batch_order(summary.descriptors, batch, every=config.segment_every)
    labelled = in_network_order(jnp.asarray(batch.labelled), batch, every=config.segment_every)
    images = labelled[:: config.segment_every].sum()
    descriptor_terms = _weighted(DESCRIPTOR_TERMS, config)
    segmentation_terms = {name: SEGMENTATION_TERMS[name] for name in summary.sums}
    values = {name: term.value(descriptors, batch, config) for name, term in descriptor_terms.items()}
    values |= {name: term.value(summary.sums[name], images) for name, term in segmentation_terms.items()}
    weights = {name: term.weight(config) for name, term in (descriptor_terms | segmentation_terms).items()}
    total = losses.joint(values, weights)
    return total, values | {"violations": violations(descriptors, batch, config), "loss": total}


def _weighted(terms: dict[str, Any], config: LossConfig) -> dict[str, Any]:
    return {name: term for name, term in terms.items() if term.weight(config)}


def _tuple_distances(
    descriptors: Float[Array, "b d"], batch: Batch, config: LossConfig
) -> tuple[Float[Array, "t p"], Float[Array, "t places"]]:
    """Return the distances of each anchor to its positives, and to all places of the tuples."""
    tuples, places = batch.negatives.shape
    descriptors = descriptors[:places]
    grouped = descriptors.reshape(tuples, -1, descriptors.shape[-1])
    anchors = grouped[:, :1]
    positives = grouped[:, 1 : 1 + batch.positives]
    to_positives = losses.descriptor_distance(*jnp.broadcast_arrays(anchors, positives), squared=config.squared)
    to_all = losses.descriptor_distance(*jnp.broadcast_arrays(anchors, descriptors[None]), squared=config.squared)
    return to_positives, to_all


def _options(batch: Batch, config: LossConfig) -> dict[str, Any]:
    return {
        "margin": config.margin,
        "closest_positive": config.closest_positive,
        "reduction": config.reduction,
        "where": jnp.asarray(batch.negatives),
    }
