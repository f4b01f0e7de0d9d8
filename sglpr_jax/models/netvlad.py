"""Poolings of the place head: NetVLAD in the form of PointNetVLAD, and the mean that replaces it in table 4."""

import flax.linen as nn
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from sglpr_jax.models import initial
from sglpr_jax.models.layers import Linear, l2_normalize, weight


class GatedNetVLAD(nn.Module):
    """NetVLAD (soft assignment of features to clusters, residual sums), a linear layer and context gating.

        a[n, k] = softmax over k of (x W + bias)

        vlad = residual_sums(x, a, centres), flattened, L2-normalised

        y = vlad * hidden + bias;  output = y * sigmoid(y G + bias)

    Biases replace PointNetVLAD's batch norm, so that an output does not depend on the rest of its batch. The sums over
    the features and all later steps are float32.
    """

    clusters: int
    output: int

    @nn.compact
    def __call__(self, features: Float[Array, "b n d"]) -> Float[Array, "b {self.output}"]:
        d = features.shape[-1]
        weights_init = initial.normal(d**-0.5)
        logits = Linear(self.clusters, kernel_init=weights_init, name="assignment")(features)
        assignment = nn.softmax(logits.astype(jnp.float32))
        centres = weight(self, "centres", weights_init, (d, self.clusters))
        vlad = l2_normalize(residual_sums(features, assignment, centres).reshape(features.shape[0], -1))
        y = Linear(self.output, kernel_init=weights_init, name="hidden")(vlad)
        gate_init = initial.normal(self.output**-0.5)
        return y * nn.sigmoid(Linear(self.output, kernel_init=gate_init, name="gate")(y))


def residual_sums(
    features: Float[Array, "b n d"], assignment: Float[Array, "b n k"], centres: Float[ArrayLike, "d k"]
) -> Float[Array, "b d k"]:
    """Return sum over n of assignment[n, k] * (features[n, d] - centres[d, k]), of length 1 over d, in float32."""
    assignment_in_type = assignment.astype(features.dtype)
    sums = jnp.einsum("bnd,bnk->bdk", features, assignment_in_type, preferred_element_type=jnp.float32)
    return l2_normalize(sums - assignment.sum(1)[:, None, :] * jnp.asarray(centres)[None], axis=1)


class MeanPooling(nn.Module):
    """Mean of a set of local features, then a linear layer."""

    output: int

    @nn.compact
    def __call__(self, features: Float[Array, "b n d"]) -> Float[Array, "b {self.output}"]:
        weights_init = initial.normal(features.shape[-1] ** -0.5)
        return Linear(self.output, kernel_init=weights_init, name="linear")(features.astype(jnp.float32).mean(1))
