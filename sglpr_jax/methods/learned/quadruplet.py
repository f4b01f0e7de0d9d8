"""Lazy quadruplet loss of PointNetVLAD and DiSCO, over the tuples of a batch."""

import functools

import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.losses import descriptor_distance, lazy_triplet
from sglpr_jax.methods.learned.method import Tuples

MARGIN, OTHER_MARGIN = 0.5, 0.2


def quadruplet(tuples: Tuples, *, closest_positive: bool) -> Float[Array, ""]:
    """Return the mean over the tuples of the lazy quadruplet loss, with d = L2 squared.

        max over negatives of [0.5 + d(anchor, p) - d(anchor, n)]_+ + the same of [0.2 + d(anchor, p) - d(o, n)]_+

    The published other negative o is far from all places of the tuple. Here it is the anchor of the next tuple, because
    tuples have no more places. Its distance from the negatives is not checked. A single tuple has no second term.

    Arguments:
      tuples: Descriptors of a batch.
      closest_positive: Whether p is the closest positive. Otherwise it is the farthest one.
    """
    squares = functools.partial(descriptor_distance, squared=True)
    anchors, places = tuples.descriptors[:, :1], tuples.descriptors[:, 1:]
    positive, negative = jnp.split(squares(*jnp.broadcast_arrays(anchors, places)), [tuples.positives], axis=1)
    total = lazy_triplet(positive, negative, margin=MARGIN, closest_positive=closest_positive)
    if len(anchors) > 1:
        others, negatives = jnp.roll(anchors, -1, axis=0), places[:, tuples.positives :]
        between = squares(*jnp.broadcast_arrays(others, negatives))
        total = total + lazy_triplet(positive, between, margin=OTHER_MARGIN, closest_positive=closest_positive)
    return total.mean()
