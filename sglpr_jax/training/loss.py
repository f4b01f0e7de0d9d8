"""The training loss: a table of terms, each with its weight. A new term is one entry, its functions and its field."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sglpr_jax import losses
from sglpr_jax.data.sampling.batch import Batch
from sglpr_jax.training.config import LossConfig
from sglpr_jax.training.place_order import in_batch_order, in_network_order

Metrics = dict[str, Float[Array, ""]]


@dataclasses.dataclass(frozen=True)
class DescriptorTerm:
    """A term of the loss that is made of the descriptors of a whole batch."""

    weight: Callable[[LossConfig], float]
    value: Callable[[Float[Array, "b d"], Batch, LossConfig], Float[Array, ""]]
    """(descriptors, batch, config) -> the term"""


@dataclasses.dataclass(frozen=True)
class SegmentationTerm:
    """A term of the loss that is made of class logits. Images come in chunks, over which the sums are added up."""

    weight: Callable[[LossConfig], float]
    sums: Callable[[Float[Array, "c h w k"], Int[Array, "c h w"], Bool[Array, "c h w"], LossConfig], Array]
    """(logits, classes, which pixels count, config) -> what is added up over the chunks"""
    value: Callable[[Any, Int[Array, ""]], Float[Array, ""]]
    """(the sums of the whole batch, how many of its segmented images have labels) -> the term"""


class Summary(NamedTuple):
    """What the loss needs of the images of a chunk, or of a whole batch."""

    descriptors: Any
    """(c, d)"""
    sums: dict[str, Any]
    """By name, what each segmentation term adds up; empty without labels."""


def triplet(descriptors: Float[Array, "b d"], batch: Batch, config: LossConfig) -> Float[Array, ""]:
    """Equation 5, averaged over the tuples of `batch.negatives`."""
    distances = _tuple_distances(descriptors, batch, config)
    options: dict[str, Any] = _options(batch, config) | {"temperature": config.temperature}
    own = losses.lazy_triplet(*distances, **options).mean()
    if not config.one_threshold:
        return own
    shared = losses.one_threshold(*distances, **options).mean()
    return (1 - config.one_threshold) * own + config.one_threshold * shared


def violations(descriptors: Float[Array, "b d"], batch: Batch, config: LossConfig) -> Float[Array, ""]:
    """The share of the tuples that still violate the margin."""
    lazy = losses.lazy_triplet(*_tuple_distances(descriptors, batch, config), **_options(batch, config))
    return (lazy > 0).mean()  # without a temperature: the smooth loss is never zero


def _cross_entropy_sum(logits: Array, classes: Array, counted: Array, config: LossConfig) -> Float[Array, ""]:
    return losses.cross_entropy(logits, classes, where=counted, balance=config.class_balance).sum()


def _cross_entropy(total: Float[Array, ""], images: Int[Array, ""]) -> Float[Array, ""]:
    """Equation 6, averaged over the labelled images."""
    return total / jnp.maximum(images, 1)


def _dice_sums(logits: Array, classes: Array, counted: Array, config: LossConfig) -> Float[Array, "3 k"]:
    return losses.dice_sums(logits, classes, counted)


def _dice(sums: Float[Array, "3 k"], images: Int[Array, ""]) -> Float[Array, ""]:
    """Equation 7 over the pixels of all labelled images; 0 where there is no such image."""
    return jnp.where(images > 0, losses.dice_from_sums(sums), 0.0)


DESCRIPTOR_TERMS = {"triplet": DescriptorTerm(lambda config: 0.0 if config.segmentation_alone else 1.0, triplet)}
SEGMENTATION_TERMS = {
    "cross_entropy": SegmentationTerm(lambda config: config.ce_weight, _cross_entropy_sum, _cross_entropy),
    "dice": SegmentationTerm(lambda config: config.dice_weight, _dice_sums, _dice),
}
"""Equation 8 is the sum of all terms, each times its weight. The names are those of the metrics and learning curves."""
TERM_NAMES = (*DESCRIPTOR_TERMS, *SEGMENTATION_TERMS)
MEASURES = {"violations": violations}
"""What is measured beside the terms, of the same arguments as a `DescriptorTerm`."""


def segmentation_sums(
    logits: Float[Array, "c h w k"], classes: Int[Array, "c h w"], counted: Bool[Array, "c h w"], config: LossConfig
) -> dict[str, Array]:
    """What the segmentation terms that have a weight need of a chunk; of `classes` the pixels that are `counted`."""
    terms = _weighted(SEGMENTATION_TERMS, config)
    return {name: term.sums(logits, classes, counted, config) for name, term in terms.items()}


def joint_loss(summary: Summary, batch: Batch, config: LossConfig) -> tuple[Float[Array, ""], Metrics]:
    """Equation 8 of a whole batch; with it, by name, its terms, what is measured beside them, and itself."""
    descriptors = in_batch_order(summary.descriptors, batch, every=config.segment_every)
    labelled = in_network_order(jnp.asarray(batch.labelled), batch, every=config.segment_every)
    images = labelled[:: config.segment_every].sum()
    of_descriptors = _weighted(DESCRIPTOR_TERMS, config)
    of_classes = {name: term for name, term in SEGMENTATION_TERMS.items() if name in summary.sums}
    terms = {name: term.value(descriptors, batch, config) for name, term in of_descriptors.items()}
    terms |= {name: term.value(summary.sums[name], images) for name, term in of_classes.items()}
    weights = {name: term.weight(config) for name, term in (of_descriptors | of_classes).items()}
    total = losses.joint(terms, weights)
    measured = {name: measure(descriptors, batch, config) for name, measure in MEASURES.items()}
    return total, terms | measured | {"loss": total}


def _weighted(terms: dict[str, Any], config: LossConfig) -> dict[str, Any]:
    return {name: term for name, term in terms.items() if term.weight(config)}


def _tuple_distances(
    descriptors: Float[Array, "b d"], batch: Batch, config: LossConfig
) -> tuple[Float[Array, "t p"], Float[Array, "t places"]]:
    """The distances of each anchor to its positives, and to all places of the tuples."""
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
