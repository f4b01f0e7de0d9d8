"""Combines two sources in one batch, such as real images without labels and simulated scans with labels."""

import dataclasses

import numpy as np

from sglpr_jax.data.sampling.batch import Batch


def mix(main: Batch, also: Batch, *, triplets: bool, share_negatives: bool) -> Batch:
    """Return one batch with the places of `main`, followed by those of `also`.

    Arguments:
      main: First batch.
      also: Second batch, from another dataset.
      triplets: Whether the triplet loss counts the tuples of both batches. Otherwise it counts only those of `main`.
      share_negatives: With `triplets`, whether the places of each batch are negatives of the anchors in the other one.
        The datasets must not share a place.
    """
    negatives = main.negatives
    if triplets:
        other = np.full((len(main.negatives), also.negatives.shape[1]), share_negatives)
        back = np.full((len(also.negatives), main.negatives.shape[1]), share_negatives)
        negatives = np.block([[main.negatives, other], [back, also.negatives]])
    labelled = np.concatenate([main.labelled, also.labelled])
    return dataclasses.replace(main, labelled=labelled, negatives=negatives, also=also)
