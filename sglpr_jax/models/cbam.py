"""CBAM (Woo et al., 2018): gates that weight a map by channel and by position."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.initial import torch_uniform
from sglpr_jax.models.layers import Linear, maximum


class ChannelGate(nn.Module):
    """x * sigmoid(mlp(mean of x) + mlp(maximum of x)), with mean and maximum over all pixels, and one MLP for both."""

    reduction: int = 16
    """Channels per hidden unit of the MLP."""

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        c = x.shape[-1]
        mean_and_maximum = jnp.stack([x.mean((1, 2)), maximum(x, (1, 2))], axis=1)
        hidden = nn.relu(Linear(max(1, c // self.reduction), name="mlp_in")(mean_and_maximum))
        logits = Linear(c, name="mlp_out")(hidden).sum(1)
        return x * nn.sigmoid(logits)[:, None, None]


class SpatialGate(nn.Module):
    """x * sigmoid(7 x 7 convolution of [maximum, mean] over channels), with bias instead of Woo's batch norm."""

    circular: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        maximum_and_mean = jnp.stack([maximum(x, (-1,)), x.mean(-1)], axis=-1)
        convolution = Convolution(1, 7, circular=self.circular, kernel_init=torch_uniform, name="convolution")
        return x * nn.sigmoid(convolution(maximum_and_mean))


class CBAM(nn.Module):
    """Channel gate, then spatial gate."""

    reduction: int = 16
    circular: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        return SpatialGate(self.circular, name="spatial")(ChannelGate(self.reduction, name="channel")(x))
