"""Adds the image to the features of the segmentation head."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.initial import lecun_normal
from sglpr_jax.models.layers import Linear, gelu

_LOCAL = ((5, 16), (3, 16))
"""Kernel size in cells, and channels, of the convolutions. Together they reach three cells in each direction."""


class Detail(nn.Module):
    """Mixes the features of every cell with the image around it.

    A patch's token cannot tell which of its many cells held how many points. This layer restores these counts.
    """

    width: int

    @nn.compact
    def __call__(self, features: Float[Array, "b h w c"], image: Float[Array, "b h w i"]) -> Float[Array, "b h w d"]:
        """Returns the mixed features, with `width` numbers for each cell."""
        image = image.astype(features.dtype)
        for i, (cells, channels) in enumerate(_LOCAL):
            image = nn.relu(Convolution(channels, cells, kernel_init=lecun_normal, name=f"local{i}")(image))
        both = jnp.concatenate([features, image], axis=-1)
        return gelu(Linear(self.width, name="mix")(both))
