"""NetVLAD's clusters at the start of a training: the k-means centres of local features of training places."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Float, Shaped
from scipy.cluster.vq import kmeans2

from sglpr_jax.methods.learned.method import Variables

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


def with_clusters(network: nn.Module, variables: Variables, inputs: Shaped[np.ndarray, "n ..."]) -> Variables:
    """Return the variables with clusters from the local features of some images.

    The centres are those of k-means (Arandjelović et al., 2016). The assignment is a * x · centre / |centre|, with the
    factor a at which the second-nearest cluster gets 0.01 of the weight of the nearest one.

    Arguments:
      network: Network that sows its local features as `FEATURES` in the collection `LOCAL`.
      variables: Random variables of the network.
      inputs: Inputs of random training places.
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
