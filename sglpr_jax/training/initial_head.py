"""Initial NetVLAD layers from images: centres by k-means of the local features, the projection by PCA."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Float
from scipy.cluster.vq import kmeans2
from scipy.spatial.distance import cdist

from sglpr_jax.models.layers import l2_normalize
from sglpr_jax.models.netvlad import residual_sums
from sglpr_jax.models.sglpr import forward
from sglpr_jax.models.weights import Params, as_tree, by_name

CHUNK = 32
"""Number of images that pass through the network at a time."""
MAX_FEATURES = 40_000
"""Maximum number of local features for k-means."""
NEAREST_SHARE = 100.0
"""Mean ratio of the assignments of a feature to its nearest and its second nearest cluster, as in NetVLAD."""
WHITENING = 0.5
"""Exponent of the standard deviation by which each principal component is divided."""


def fit_netvlad(params: Params, images: Float[np.ndarray, "n h w"], *, seed: int) -> Params:
    """Return the model with NetVLAD layers that fit the images. The other weights stay.

    Each cluster is a centre of k-means of the local features, and the linear layer is the projection on the principal
    components of the residual sums. The gate is open. Raises ValueError without NetVLAD, or with fewer images than the
    descriptor has numbers.
    """
    head, rng = params.config.head, np.random.default_rng(seed)
    if head.pooling != "netvlad" or len(images) < head.descriptor_size:
        raise ValueError(
            f"expected a head with NetVLAD and at least {head.descriptor_size} images to fit it to, "
            f"found {head.pooling} and {len(images)} images"
        )
    features = np.concatenate([_local_features(params, images[i : i + CHUNK]) for i in range(0, len(images), CHUNK)])
    flat = features.reshape(-1, features.shape[-1])
    some = rng.choice(flat, min(len(flat), MAX_FEATURES), replace=False)
    centres, _ = kmeans2(some.astype(np.float64), head.clusters, minit="++", seed=rng)
    first, second = np.partition(cdist(some, centres, "sqeuclidean"), 1, axis=1)[:, :2].T
    sharpness = np.log(NEAREST_SHARE) / max(float((second - first).mean()), 1e-12)
    logits = 2 * sharpness * features @ centres.T - sharpness * np.square(centres).sum(1)
    assignment = jax.nn.softmax(logits.astype(np.float32))
    sums = residual_sums(features, assignment, centres.T.astype(np.float32))
    vectors = np.asarray(l2_normalize(sums.reshape(len(features), -1)), np.float64)
    mean = vectors.mean(0)
    _, deviations, axes = np.linalg.svd(vectors - mean, full_matrices=False)
    size = head.descriptor_size
    projection = axes[:size].T / np.maximum(deviations[:size], 1e-6 * deviations[0]) ** WHITENING
    fitted = {
        "assignment/kernel": 2 * sharpness * centres.T,
        "assignment/bias": -sharpness * np.square(centres).sum(1),
        "centres": centres.T,
        "hidden/kernel": projection,
        "hidden/bias": -mean @ projection,
        "gate/kernel": np.zeros((size, size)),
        "gate/bias": np.zeros(size),
    }
    named = {f"place_head/netvlad/{name}": np.asarray(value, np.float32) for name, value in fitted.items()}
    return dataclasses.replace(params, weights=as_tree({**by_name(params.weights), **named}))


@jax.jit
def _features(params: Params, images: Float[np.ndarray, "n h w"]) -> Float[np.ndarray, "n f d"]:
    last = forward(params, images, segment=0).intermediates[f"head_convolution{len(params.config.head.channels) - 1}"]
    return last.reshape(last.shape[0], -1, last.shape[-1])


def _local_features(params: Params, images: Float[np.ndarray, "n h w"]) -> Float[np.ndarray, "n f d"]:
    """Return the features that NetVLAD pools. The last chunk is padded, so that one program is compiled."""
    padded = np.concatenate([images, np.repeat(images[-1:], CHUNK - len(images), axis=0)])
    return np.asarray(_features(params, padded))[: len(images)]
