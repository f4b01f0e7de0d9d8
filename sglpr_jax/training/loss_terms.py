"""Terms of the training loss and their weights, in two tables. `losses.py` has the functions that the terms use."""

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
    """Term of the loss that depends on class logits: `value` of the sums over all chunks of images of a batch."""

    weight: Callable[[LossConfig], float]
    sums: Callable[[Float[Array, "c h w k"], Int[Array, "c h w"], Bool[Array, "c h w"], LossConfig], Array]
    """`(logits, classes, mask of the counted pixels, config) -> sums of one chunk`"""
    value: Callable[[Any, Int[Array, ""]], Float[Array, ""]]
    """`(sums of the batch, number of segmented images with labels) -> value of the term`"""


class Summary(NamedTuple):
    """What the loss needs of the images of a chunk or of a whole batch."""

    descriptors: Any
    """Descriptors (images, d)."""
    sums: dict[str, Any]
    """Sums of each segmentation term, by its name. Empty without labels."""


def triplet(descriptors: Float[Array, "b d"], batch: Batch, config: LossConfig) -> Float[Array, ""]:
    """Return the triplet loss (equation 5), averaged over the tuples that the rows of `batch.negatives` stand for.

    The fraction `config.one_threshold` of it is the loss in which every anchor has the negatives of all anchors.
    """
    to_positives, to_places = _anchor_distances(descriptors, batch, config)
    where = jnp.asarray(batch.negatives)
    options: dict[str, Any] = {"margin": config.margin, "temperature": config.temperature, "where": where}
    own_negatives = losses.lazy_triplet(to_positives, to_places, **options).mean()
    if not config.one_threshold:
        return own_negatives
    all_negatives = losses.one_threshold(to_positives, to_places, **options).mean()
    return (1 - config.one_threshold) * own_negatives + config.one_threshold * all_negatives


def violations(descriptors: Float[Array, "b d"], batch: Batch, config: LossConfig) -> Float[Array, ""]:
    """Return the fraction of tuples that violate the margin: those whose loss without a temperature is above 0."""
    to_positives, to_places = _anchor_distances(descriptors, batch, config)
    where = jnp.asarray(batch.negatives)
    return (losses.lazy_triplet(to_positives, to_places, margin=config.margin, where=where) > 0).mean()


def teacher_distance(descriptors: Float[Array, "b d"], batch: Batch, config: LossConfig) -> Float[Array, ""]:
    """Return the mean squared distance of the descriptors from those of the teacher."""
    return losses.descriptor_distance(descriptors, batch.teacher, squared=True).mean()


DESCRIPTOR_TERMS = {
    "triplet": DescriptorTerm(lambda config: 0.0 if config.segmentation_alone or config.teacher else 1.0, triplet),
    "teacher": DescriptorTerm(lambda config: 1.0 if config.teacher else 0.0, teacher_distance),
}
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
    """Return the joint loss (equation 8), and the metrics by name: its terms, `violations` and the loss itself.

    `summary` has the images in network order, in which the head saw the first of every `config.segment_every`.
    """
    descriptors = in_batch_order(summary.descriptors, batch, every=config.segment_every)
    labelled = in_network_order(jnp.asarray(batch.labelled), batch, every=config.segment_every)
    segmented_images = labelled[:: config.segment_every].sum()
    descriptor_terms = _weighted(DESCRIPTOR_TERMS, config)
    segmentation_terms = {name: SEGMENTATION_TERMS[name] for name in summary.sums}
    values = {name: term.value(descriptors, batch, config) for name, term in descriptor_terms.items()}
    values |= {name: term.value(summary.sums[name], segmented_images) for name, term in segmentation_terms.items()}
    weights = {name: term.weight(config) for name, term in (descriptor_terms | segmentation_terms).items()}
    total = losses.joint(values, weights)
    return total, values | {"violations": violations(descriptors, batch, config), "loss": total}


def _weighted(terms: dict[str, Any], config: LossConfig) -> dict[str, Any]:
    """Return the terms with a nonzero weight."""
    return {name: term for name, term in terms.items() if term.weight(config)}


def _anchor_distances(
    descriptors: Float[Array, "b d"], batch: Batch, config: LossConfig
) -> tuple[Float[Array, "t p"], Float[Array, "t places"]]:
    """Return the distances of each anchor to its positives, and to each descriptor of the batch.

    `batch.negatives` has the same shape as the second result, and tells which of these descriptors are negatives.
    """
    tuples, places = batch.negatives.shape
    descriptors = descriptors[:places]  # without those of a second batch that the triplet loss ignores
    by_tuple = descriptors.reshape(tuples, -1, descriptors.shape[-1])
    anchors, positives = by_tuple[:, :1], by_tuple[:, 1 : 1 + batch.positives]
    to_positives = losses.descriptor_distance(*jnp.broadcast_arrays(anchors, positives), squared=config.squared)
    to_places = losses.descriptor_distance(*jnp.broadcast_arrays(anchors, descriptors[None]), squared=config.squared)
    return to_positives, to_places
