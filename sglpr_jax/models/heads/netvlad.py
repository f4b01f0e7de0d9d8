"""NetVLAD: pools a set of local features into one vector, in the form of PointNetVLAD (Uy and Lee 2018)."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models import initial
from sglpr_jax.models.layers import Linear, l2_normalize, weight


class NetVLAD(nn.Module):
    """Soft assignment of features to clusters, sums of residuals per cluster, a linear layer and context gating.

        a[n, k] = softmax over k of (x W + bias)

        vlad[d, k] = sum over n of a[n, k] * (x[n, d] - centre[d, k]), L2-normalised over d, then as a whole

        y = vlad * hidden + bias;  output = y * sigmoid(y G + bias)

    Biases replace PointNetVLAD's batch norm, so that an output does not depend on the rest of its batch.
    """

    clusters: int
    output: int
    gating: bool = True

    @nn.compact
    def __call__(self, features: Float[Array, "b n d"]) -> Float[Array, "b {self.output}"]:
        """Returns the vector before its final L2 normalisation.

        The sums over the features and all later steps are float32.
        """
        d = features.shape[-1]
        weights_init = initial.normal(d**-0.5)
        logits = Linear(self.clusters, kernel_init=weights_init, name="assignment")(features)
        assignment = nn.softmax(logits.astype(jnp.float32))
        centres = weight(self, "centres", weights_init, (d, self.clusters))
        weights = assignment.astype(features.dtype)
        residuals = jnp.einsum("bnd,bnk->bdk", features, weights, preferred_element_type=jnp.float32)
        residuals = residuals - assignment.sum(1)[:, None, :] * centres[None]
        vlad = l2_normalize(residuals, axis=1).reshape(features.shape[0], -1)
        y = Linear(self.output, kernel_init=weights_init, name="hidden")(l2_normalize(vlad))
        if not self.gating:
            return y
        gate_init = initial.normal(self.output**-0.5)
        return y * nn.sigmoid(Linear(self.output, kernel_init=gate_init, name="gate")(y))
