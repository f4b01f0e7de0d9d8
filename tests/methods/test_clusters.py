"""NetVLAD's clusters at the start: centres of the local features, and an assignment of stated sharpness."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from sglpr_jax.methods.learned.clusters import FEATURES, LOCAL, with_clusters
from sglpr_jax.methods.learned.image_layers import NetVLAD
from sglpr_jax.models.layers import l2_normalize

DIRECTIONS = l2_normalize(2 + jax.random.normal(jax.random.key(0), (8, 16)))


class Points(nn.Module):
    """Local features near 8 directions, which differ little and are chosen by the input, and 8 clusters."""

    @nn.compact
    def __call__(self, inputs, *, train):
        local = l2_normalize(DIRECTIONS[inputs] + 0.01 * jnp.cos(jnp.arange(16.0)[None, None] * inputs[..., None]))
        self.sow(LOCAL, FEATURES, local)
        return NetVLAD(8)(local)


@pytest.fixture(scope="module")
def clustered():
    inputs = np.random.default_rng(0).integers(0, 8, (20, 30))
    variables = Points().init(jax.random.key(0), inputs[:1], train=False)
    return inputs, variables, with_clusters(Points(), {"params": variables["params"]}, inputs)


def test_centres_are_those_of_the_features(clustered):
    centres = clustered[2]["params"]["NetVLAD_0"]["centres"]
    nearest = np.linalg.norm(DIRECTIONS[:, None] - centres[None], axis=-1)
    assert nearest.min(1).max() < 0.1
    assert sorted(nearest.argmin(1)) == list(range(8))


def test_the_second_nearest_cluster_gets_a_hundredth(clustered):
    inputs, _, found = clustered
    _, local = Points().apply(found, inputs, train=False, mutable=[LOCAL])
    logits = np.sort(local[LOCAL][FEATURES][0] @ found["params"]["NetVLAD_0"]["assignment"], axis=-1)
    assert np.mean(logits[..., -1] - logits[..., -2]) == pytest.approx(np.log(100), rel=0.05)


def test_descriptors_are_farther_apart(clustered):
    inputs, before, after = clustered

    def apart(variables):
        found = Points().apply({"params": variables["params"]}, inputs, train=False)
        return np.linalg.norm(found[:, None] - found[None], axis=-1).mean()

    assert apart(after) > 1.5 * apart(before)
