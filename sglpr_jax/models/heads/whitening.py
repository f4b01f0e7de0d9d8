"""Whitening: an optional last layer of the place head, fitted by models/whitening.py."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models import initial
from sglpr_jax.models.layers import l2_normalize, weight


class Whitening(nn.Module):
    """Linear layer and L2 normalisation. It is the identity until it is fitted."""

    @nn.compact
    def __call__(self, descriptor: Float[Array, "b d"]) -> Float[Array, "b d"]:
        """Returns descriptors of length 1."""
        d = descriptor.shape[-1]
        kernel = weight(self, "kernel", initial.identity, (d, d))
        bias = weight(self, "bias", initial.zeros, (d,))
        return l2_normalize(jnp.matmul(descriptor, kernel, precision=jax.lax.Precision.HIGHEST) + bias[None])
