"""CBAM: weights a feature map by channel, then by position (Woo et al. 2018)."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.initial import torch_uniform
from sglpr_jax.models.layers import Linear

ROUNDING = 1e-6


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def largest(x: Float[Array, "*dims"], axes: tuple[int, ...]) -> Float[Array, "*rest"]:
    """Maximum over some axes. All entries within rounding of the maximum share its gradient.

    The gradient of `jnp.max` goes to the entries equal to the maximum. XLA may compute `x` again for the gradient and
    round it differently. Then no entry is equal, and the gradient is 0 / 0.
    """
    return x.max(axes)


@largest.defjvp
def _largest_jvp(axes, primals, tangents):
    (x,), (dx,) = primals, tangents
    y = x.max(axes, keepdims=True)
    hit = x >= y - ROUNDING * (1 + jnp.abs(y))
    return y.squeeze(axes), jnp.where(hit, dx, 0).sum(axes) / jnp.maximum(hit.sum(axes), 1)


class ChannelGate(nn.Module):
    """x * sigmoid(mlp(mean of x) + mlp(maximum of x)), pooled over the image; one shared two-layer MLP."""

    reduction: int = 16

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        """The hidden layer of the MLP has max(1, c // reduction) units."""
        c = x.shape[-1]
        pooled = jnp.stack([x.mean((1, 2)), largest(x, (1, 2))], axis=1)
        hidden = nn.relu(Linear(max(1, c // self.reduction), name="mlp_in")(pooled))
        logits = Linear(c, name="mlp_out")(hidden).sum(1)
        return x * nn.sigmoid(logits)[:, None, None]


class SpatialGate(nn.Module):
    """x * sigmoid(convolution of [maximum, mean] over channels), 7 x 7.

    The convolution has a bias instead of the original's batch norm, which can be folded into it. With `circular=True`
    the columns wrap around.
    """

    circular: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        """Applies one weight per pixel."""
        pooled = jnp.stack([largest(x, (-1,)), x.mean(-1)], axis=-1)
        convolution = Convolution(1, 7, circular=self.circular, kernel_init=torch_uniform, name="convolution")
        return x * nn.sigmoid(convolution(pooled))


class CBAM(nn.Module):
    """Channel gate, then spatial gate."""

    reduction: int = 16
    circular: bool = False
    """Whether the left and right borders of the map are neighbours."""

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        """Returns the weighted map. There is no residual connection."""
        return SpatialGate(self.circular, name="spatial")(ChannelGate(self.reduction, name="channel")(x))
