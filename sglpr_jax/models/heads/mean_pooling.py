"""Global average pooling, which replaces NetVLAD in an ablation (table 4)."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models import initial
from sglpr_jax.models.layers import Linear


class MeanPooling(nn.Module):
    """Mean of a set of local features, then a linear layer."""

    output: int

    @nn.compact
    def __call__(self, features: Float[Array, "b n d"]) -> Float[Array, "b {self.output}"]:
        """Returns the vector before its L2 normalisation."""
        weights_init = initial.normal(features.shape[-1] ** -0.5)
        return Linear(self.output, kernel_init=weights_init, name="linear")(features.astype(jnp.float32).mean(1))
