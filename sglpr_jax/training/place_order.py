"""In which order the places of a mixed batch go through the network.

The segmentation head looks at every n-th image. Where labels come from a second source, its places are put there, so
that the head spends nothing on images without labels.
"""

import numpy as np
from jaxtyping import Array, Int, Shaped

from sglpr_jax.data.sampling.batch import Batch


def in_network_order(x: Shaped[Array, "b *_"], batch: Batch, *, every: int) -> Shaped[Array, "b *_"]:
    """What belongs to the places of a batch, in the order of the network, whose head looks at `every` n-th image."""
    return x if batch.also is None else x[_order(batch, every)]


def in_batch_order(x: Shaped[Array, "b *_"], batch: Batch, *, every: int) -> Shaped[Array, "b *_"]:
    """The inverse of `in_network_order`."""
    return x if batch.also is None else x[np.argsort(_order(batch, every))]


def _order(batch: Batch, every: int) -> Int[np.ndarray, "b"]:
    places = len(batch.labelled)
    segmented_slots_first = np.argsort(np.arange(places) % every, kind="stable")
    order = np.empty(places, int)
    order[segmented_slots_first] = np.roll(np.arange(places), -batch.places)
    return order
