"""Training losses, equations 5 to 8. Sums over a batch are separate functions, so that a batch can come in chunks."""

import functools
import operator
from collections.abc import Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

DICE_EPSILON = 1e-5
"""Term added to numerator and denominator of the Dice coefficient, against division by zero."""


def descriptor_distance(
    a: Float[Array, "*b d"], b: Float[Array, "*b d"], *, squared: bool = False
) -> Float[Array, "*b"]:
    """Euclidean distance between descriptors, or its square. The gradient at distance zero is zero, not NaN."""
    square = jnp.square(a - b).sum(-1)
    if squared:
        return square
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def lazy_triplet(
    positive: Float[Array, "*t p"],
    negative: Float[Array, "*t n"],
    *,
    margin: float,
    closest_positive: bool = True,
    reduction: Literal["max", "sum"] = "max",
    temperature: float = 0.0,
    where: Bool[Array, "*t n"] | None = None,
) -> Float[Array, "*t"]:
    """Lazy triplet loss (equation 5) of each tuple of an anchor with its positives and negatives.

    Arguments:
      positive: Distances of each anchor to its k_p positives.
      negative: Distances of each anchor to its k_n negatives.
      margin: Margin between the distances of positives and negatives.
      closest_positive: Whether to use the closest positive. Otherwise the farthest is used.
      reduction: "max" for the lazy loss. "sum" for the triplet loss, in which every negative inside the margin counts.
      temperature: T > 0 replaces max_i [x_i]_+ by the smooth T log(1 + sum_i exp(x_i / T)). The maximum pulls untrained
        descriptors into one point, where its gradient vanishes.
      where: Mask of the negatives. A tuple without negatives has loss 0.
    """
    positive_distance = positive.min(-1) if closest_positive else positive.max(-1)
    violation = margin + positive_distance[..., None] - negative
    if where is not None:
        violation = jnp.where(where, violation, -jnp.inf)
    if temperature > 0:
        return temperature * jax.nn.softplus(jax.nn.logsumexp(violation / temperature, axis=-1))
    hinge = jax.nn.relu(violation)
    return hinge.max(-1) if reduction == "max" else hinge.sum(-1)


def one_threshold(
    positive: Float[Array, "t p"], negative: Float[Array, "t n"], *, where: Bool[Array, "t n"], **options: Any
) -> Float[Array, "t"]:
    """Lazy triplet loss, with the options of `lazy_triplet`, in which every anchor has the negatives of all anchors.

    Equation 5 compares the distances of one anchor, but loops are accepted below one distance for all places. Here the
    distance to a positive must be below the distance of any two different places.
    """
    shape = (len(positive), negative.size)
    all_negatives = jnp.broadcast_to(negative.reshape(1, -1), shape)
    return lazy_triplet(positive, all_negatives, where=jnp.broadcast_to(where.reshape(1, -1), shape), **options)


def cross_entropy(
    logits: Float[Array, "*b h w k"],
    labels: Int[Array, "*b h w"],
    *,
    where: Bool[Array, "*b h w"] | None = None,
    balance: float = 0.0,
) -> Float[Array, "*b"]:
    """Cross-entropy of each image (equation 6), averaged over its pixels.

    Arguments:
      logits: Logits of the classes.
      labels: Class of each pixel.
      where: Mask of the pixels that count. Without pixels the loss is zero.
      balance: Exponent a of the class balance. A pixel has the weight n^-a, where n pixels of the image have its class.
        0 is the plain average; with 1 all classes have the same weight.
    """
    entropy = optax.softmax_cross_entropy_with_integer_labels(logits, labels)
    weight = jnp.ones_like(entropy) if where is None else where.astype(entropy.dtype)
    if balance:
        one_hot = jax.nn.one_hot(labels, logits.shape[-1], dtype=entropy.dtype)
        pixels_of_class = jnp.einsum("...hw,...hwk->...k", weight, one_hot)
        weight = weight * jnp.einsum("...k,...hwk->...hw", jnp.maximum(pixels_of_class, 1) ** -balance, one_hot)
    return (weight * entropy).sum((-2, -1)) / jnp.maximum(weight.sum((-2, -1)), 1e-6)


def dice_sums(
    logits: Float[Array, "b h w k"], labels: Int[Array, "b h w"], where: Bool[Array, "b h w"] | None = None
) -> Float[Array, "3 k"]:
    """Sums of equation 7 over images and pixels, per class: p t, p^2 and t^2, for probability p and one-hot label t.

    `where` is a mask of the pixels that count. The sums of parts of a batch can be added.
    """
    probability = jax.nn.softmax(logits)
    truth = jax.nn.one_hot(labels, logits.shape[-1], dtype=logits.dtype)
    if where is not None:
        probability, truth = (jnp.where(where[..., None], x, 0.0) for x in (probability, truth))
    products = probability * truth, probability * probability, truth * truth
    return jnp.stack([product.sum((0, 1, 2)) for product in products])


def dice_from_sums(sums: Float[Array, "3 k"]) -> Float[Array, ""]:
    """Dice loss (equation 7) from the `dice_sums` of a whole batch: the mean over the classes of one minus Dice."""
    intersection, probability_squares, truth_squares = sums
    dice = (2 * intersection + DICE_EPSILON) / (probability_squares + truth_squares + DICE_EPSILON)
    return (1 - dice).mean()


def joint(terms: Mapping[str, Float[Array, ""]], weights: Mapping[str, float]) -> Float[Array, ""]:
    """Joint loss (equation 8): the weighted sum of loss terms (triplet 1, cross-entropy 0.4, Dice 0.6 in the paper)."""
    return functools.reduce(operator.add, (weights[name] * term for name, term in terms.items()))
