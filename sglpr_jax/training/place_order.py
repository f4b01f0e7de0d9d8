"""Order in which the places of a mixed batch pass through the network.

The segmentation head sees every n-th image. If the labels come from a second dataset, its places are put there. The
head then spends no time on images without labels.
"""

import numpy as np
from jaxtyping import Array, Int, Shaped

from sglpr_jax.data.sampling.batch import Batch


def in_network_order(x: Shaped[Array, "b *_"], batch: Batch, *, every: int) -> Shaped[Array, "b *_"]:
    """Reorder values of the places of a batch into network order. The segmentation head sees every `every`-th image."""
    return x if batch.also is None else x[_order(batch, every)]


def in_batch_order(x: Shaped[Array, "b *_"], batch: Batch, *, every: int) -> Shaped[Array, "b *_"]:
    """Inverse of `in_network_order`."""
    return x if batch.also is None else x[np.argsort(_order(batch, every))]


def _order(batch: Batch, every: int) -> Int[np.ndarray, "b"]:
    places = len(batch.labelled)
    segmented_slots_first = np.argsort(np.arange(places) % every, kind="stable")
    order = np.empty(places, int)
    order[segmented_slots_first] = np.roll(np.arange(places), -batch.places)
    return order
