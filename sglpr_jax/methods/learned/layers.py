"""Layers of the learned methods: convolution, normalisation, pooling, and NetVLAD with the fit of its clusters."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Shaped

from sglpr_jax.methods.learned.method import Variables
from sglpr_jax.models import convolution
from sglpr_jax.models.layers import l2_normalize, product
from sglpr_jax.models.netvlad import residual_sums

HE = nn.initializers.variance_scaling(2.0, "fan_out", "normal")
"""Initial values of the kernels, as in the residual networks of He et al. (2016)."""
LOCAL, FEATURES = "local", "features"
"""Collection and name in Flax under which a network stores (sows) the local features that it gives to NetVLAD."""
NETVLAD_NAME = "NetVLAD_0"
"""Name of the parameters of NetVLAD in a network."""
FEATURES_PER_IMAGE, ITERATIONS = 100, 100
"""Number of local features of each image, and number of iterations, for k-means."""
BATCH = 4
"""Number of images at a time for k-means. Batch normalisation uses their statistics, as in a training."""
SECOND_WEIGHT = 0.01
"""Weight of the second-nearest cluster, divided by that of the nearest one, for the average feature."""

Convolution = functools.partial(convolution.Convolution, kernel_init=HE, use_bias=False)


def batch_norm(train: bool, *, epsilon: float = 1e-5) -> nn.BatchNorm:
    """Return a batch normalisation with PyTorch's epsilon. In evaluation it uses the running statistics."""
    return nn.BatchNorm(use_running_average=not train, momentum=0.9, epsilon=epsilon)


def max_pool(x: Float[Array, "b h w c"], *, size: int, border: int = 0) -> Float[Array, "b _ _ c"]:
    """Return the maximum of each square of `size` x `size` pixels, with stride 2 and padding `border` on each side."""
    padding: Any = ((border, border), (border, border))  # Flax declares only the type of named paddings
    return nn.max_pool(x, (size, size), (2, 2), padding)


class NetVLAD(nn.Module):
    """softmax(x W) assigns local features of length 1 to clusters. The `residual_sums` are flattened and normalised."""

    clusters: int = 64

    @nn.compact
    def __call__(self, x: Float[Array, "b n d"]) -> Float[Array, "b {self.clusters}*d"]:
        d = x.shape[-1]
        weights = self.param("assignment", nn.initializers.normal(1.0), (d, self.clusters))
        centres = self.param("centres", nn.initializers.normal(d**-0.5), (self.clusters, d))
        logits = product(x.reshape(-1, d), weights).reshape(*x.shape[:2], self.clusters)
        vlad = residual_sums(x, nn.softmax(logits), centres.T)
        return l2_normalize(vlad.swapaxes(1, 2).reshape(len(x), -1))


def fit_clusters(network: nn.Module, variables: Variables, inputs: Shaped[np.ndarray, "n ..."]) -> Variables:
    """Return the variables with clusters of NetVLAD fitted to the local features of some inputs (sown by the network).

    The centres are those of k-means (Arandjelović et al., 2016). The logit of a cluster is a * x · centre / |centre|,
    with the factor a for which the second-nearest cluster gets `SECOND_WEIGHT` times the weight of the nearest one.
    """
    from scipy.cluster.vq import kmeans2  # imported here because the import is slow

    @jax.jit
    def local_features(images: Any) -> Any:
        mutable = [LOCAL, *(name for name in variables if name != "params")]
        _, changed = network.apply(variables, images, train=True, mutable=mutable)
        return changed[LOCAL][FEATURES][0]

    rng = np.random.default_rng(0)
    samples = []
    for start in range(0, len(inputs) - len(inputs) % BATCH, BATCH):
        for features in np.asarray(local_features(inputs[start : start + BATCH])):
            size = min(FEATURES_PER_IMAGE, len(features))
            samples.append(features[rng.choice(len(features), size, replace=False)])
    sample = np.concatenate(samples)
    clusters = len(variables["params"][NETVLAD_NAME]["centres"])
    centres, _ = kmeans2(sample, clusters, iter=ITERATIONS, minit="++", rng=np.random.default_rng(0))
    unit_centres = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    second_similarity, first_similarity = np.sort(sample @ unit_centres.T, axis=1)[:, -2:].T
    factor = -np.log(SECOND_WEIGHT) / np.mean(first_similarity - second_similarity)
    layer = {"assignment": jnp.asarray((factor * unit_centres).T), "centres": jnp.asarray(centres)}
    return {**variables, "params": {**variables["params"], NETVLAD_NAME: layer}}
