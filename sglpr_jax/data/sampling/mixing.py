"""Two sources in one batch: real images without labels, say, and simulated scans with them."""

import dataclasses

import numpy as np

from sglpr_jax.data.sampling.batch import Batch


def mix(main: Batch, also: Batch, *, triplets: bool, share_negatives: bool) -> Batch:
    """One batch with the places of `also` after those of `main`.

    With `triplets` the tuples of both count in the triplet loss, and with `share_negatives` each source's places are
    negatives of the other's anchors, since no place is in two datasets. Without `triplets` the loss sees `main` alone.
    """
    negatives = main.negatives
    if triplets:
        other = np.full((len(main.negatives), also.negatives.shape[1]), share_negatives)
        back = np.full((len(also.negatives), main.negatives.shape[1]), share_negatives)
        negatives = np.block([[main.negatives, other], [back, also.negatives]])
    labelled = np.concatenate([main.labelled, also.labelled])
    return dataclasses.replace(main, labelled=labelled, negatives=negatives, also=also)
