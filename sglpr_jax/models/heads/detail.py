"""The image itself beside the features, for the segmentation head alone."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.layers import Linear, gelu

_INIT = nn.initializers.lecun_normal()
_LOCAL = ((5, 16), (3, 16))
"""Cells and channels of the convolutions: together they see what lies within three cells."""


class Detail(nn.Module):
    """Mix the features of every cell with what the image shows around it.

    A patch's token cannot say which of its many cells held how many points; here the head is told.
    """

    width: int

    @nn.compact
    def __call__(self, features: Float[Array, "b h w c"], image: Float[Array, "b h w i"]) -> Float[Array, "b h w d"]:
        """The mixed features, `width` numbers for each cell."""
        image = image.astype(features.dtype)
        for i, (cells, channels) in enumerate(_LOCAL):
            image = nn.relu(Convolution(channels, cells, kernel_init=_INIT, name=f"local{i}")(image))
        both = jnp.concatenate([features, image], axis=-1)
        return gelu(Linear(self.width, name="mix")(both))
