"""Layers of the learned methods: convolution, normalisation, pooling, and NetVLAD with its clusters at the start."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Shaped
from scipy.cluster.vq import kmeans2

from sglpr_jax.methods.learned.method import Variables
from sglpr_jax.models import convolution
from sglpr_jax.models.layers import l2_normalize, product

HE = nn.initializers.variance_scaling(2.0, "fan_out", "normal")
"""Initial values of the kernels, as in the residual networks of He et al. (2016)."""
LOCAL, FEATURES = "local", "features"
"""Collection and name in which a network sows the local features that it gives to NetVLAD."""
VLAD = "NetVLAD_0"
"""Name of the parameters of NetVLAD."""
POSITIONS, ITERATIONS = 100, 100
"""Number of features of each image, and of iterations of k-means."""
BATCH = 4
"""Number of images that are described at a time. Batch normalisation uses the statistics of these, as in a training."""
FAR = 0.01
"""Weight of the second-nearest cluster, divided by that of the nearest one, for the average feature."""


Convolution = functools.partial(convolution.Convolution, kernel_init=HE, use_bias=False)


def batch_norm(train: bool) -> nn.BatchNorm:
    """Return a batch normalisation with PyTorch's settings. In evaluation it uses the running statistics."""
    return nn.BatchNorm(use_running_average=not train, momentum=0.9, epsilon=1e-5)


def max_pool(x: Float[Array, "b h w c"], *, size: int, border: int = 0) -> Float[Array, "b _ _ c"]:
    """Return the maximum of each square of `size` pixels, with stride 2. `border` is the padding on each side."""
    padding: Any = ((border, border), (border, border))  # Flax declares the type of the names alone.
    return nn.max_pool(x, (size, size), (2, 2), padding)


class NetVLAD(nn.Module):
    """Soft assignment of local features to clusters, and sums of their residuals. There are no biases.

        a[n, k] = softmax over k of x[n] W[:, k]

        vlad[k, d] = sum over n of a[n, k] * (x[n, d] - centre[k, d]), L2-normalised over d, then as a whole

    The result is flattened cluster by cluster. Local features should have unit length.
    """

    clusters: int = 64

    @nn.compact
    def __call__(self, x: Float[Array, "b n d"]) -> Float[Array, "b {self.clusters}*d"]:
        """Pool the features of each image into one vector of unit length."""
        d = x.shape[-1]
        weights = self.param("assignment", nn.initializers.normal(1.0), (d, self.clusters))
        centres = self.param("centres", nn.initializers.normal(d**-0.5), (self.clusters, d))
        logits = product(x.reshape(-1, d), weights).reshape(*x.shape[:2], self.clusters)
        assigned = nn.softmax(logits)
        residuals = jnp.einsum("bnk,bnd->bkd", assigned, x) - assigned.sum(1)[..., None] * centres[None]
        return l2_normalize(l2_normalize(residuals).reshape(len(x), -1))


def with_clusters(network: nn.Module, variables: Variables, inputs: Shaped[np.ndarray, "n ..."]) -> Variables:
    """Return the variables with clusters from the local features of some inputs, which the network sows.

    The centres are those of k-means (Arandjelović et al., 2016). The assignment is a * x · centre / |centre|, with the
    factor a at which the second-nearest cluster gets 0.01 of the weight of the nearest one.
    """
    features = _local_features(network, variables, inputs)
    vlad = variables["params"][VLAD]
    centres, _ = kmeans2(features, len(vlad["centres"]), iter=ITERATIONS, minit="++", rng=np.random.default_rng(0))
    units = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    second, first = np.sort(features @ units.T, axis=1)[:, -2:].T
    factor = -np.log(FAR) / np.mean(first - second)
    new = {"assignment": jnp.asarray((factor * units).T), "centres": jnp.asarray(centres)}
    return {**variables, "params": {**variables["params"], VLAD: new}}


def _local_features(
    network: nn.Module, variables: Variables, inputs: Shaped[np.ndarray, "n ..."]
) -> Float[np.ndarray, "m d"]:
    """Return local features of all images at random positions."""

    @jax.jit
    def of_batch(images: Any) -> Any:
        kept = [LOCAL, *(name for name in variables if name != "params")]
        return network.apply(variables, images, train=True, mutable=kept)[1][LOCAL][FEATURES][0]

    rng, found = np.random.default_rng(0), []
    for start in range(0, len(inputs) - len(inputs) % BATCH, BATCH):
        features = np.asarray(of_batch(inputs[start : start + BATCH]))
        found += [each[rng.choice(len(each), min(POSITIONS, len(each)), replace=False)] for each in features]
    return np.concatenate(found)


def maximum(x: Float[Array, "..."], axis: int) -> Float[Array, "..."]:
    """Return the maximum along an axis, whose derivative reaches one of the largest values.

    On a CPU, XLA may compute the values a second time with other rounding. Then the derivative of `jnp.max` is NaN.
    """
    place = jnp.argmax(jax.lax.stop_gradient(x), axis, keepdims=True)
    return jnp.take_along_axis(x, place, axis, mode="promise_in_bounds").squeeze(axis)
