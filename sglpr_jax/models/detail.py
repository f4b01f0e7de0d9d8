"""The image itself beside the features, for the segmentation head alone."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.layers import Linear, gelu

_LOCAL = ((5, 16), (3, 16))
"""Cells and channels of the convolutions: together they see what lies within three cells."""


class Detail(nn.Module):
    """Mix the features of every pixel with what the image shows around it.

    A patch's token cannot say which of its many cells held how many points; here the head is told.
    """

    width: int
    circular: bool

    @nn.compact
    def __call__(self, pixels: Float[Array, "b h w c"], image: Float[Array, "b h w i"]) -> Float[Array, "b h w d"]:
        for i, (cells, channels) in enumerate(_LOCAL):
            convolution = nn.Conv(channels, (cells, cells), padding="VALID", name=f"local{i}")
            image = nn.relu(convolution(self._pad(image, cells)))
        both = jnp.concatenate([pixels, image], axis=-1)
        return gelu(Linear(self.width, name="mix")(both))

    def _pad(self, image: Array, cells: int) -> Array:
        """Columns go around where the image is polar."""
        around = (cells // 2, cells // 2)
        columns = "wrap" if self.circular else "constant"
        image = jnp.pad(image, ((0, 0), around, (0, 0), (0, 0)))
        return jnp.pad(image, ((0, 0), (0, 0), around, (0, 0)), mode=columns)
