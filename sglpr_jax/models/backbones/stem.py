"""Convolutions in front of the Swin-Unet, and the way back from its tokens past them to pixels.

A linear patch embedding must guess the shape of a car's side from one layer; convolutions see it step by step. What
they see on the way is lost in the tokens, so that the segmentation head looks at it again.
"""

from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.backbones.swin_layers import FinalPatchExpand
from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.layers import LayerNorm


class Stem(nn.Module):
    """Two 3 x 3 convolutions at each resolution, the first of `widths` channels at the image's own."""

    widths: tuple[int, ...]
    circular: bool = False

    @nn.compact
    def __call__(self, image: Float[Array, "b h w c"]) -> list[Float[Array, "b _ _ _"]]:
        """The map of each resolution, finest first."""
        x, maps = image, []
        for level, width in enumerate(self.widths):
            stride = 2 if level else 1
            down = Convolution(width, strides=(stride, stride), circular=self.circular, name=f"down_{level}")
            x = nn.relu(down(x))
            if level:
                x = Convolution(width, circular=self.circular, name=f"convolution_{level}")(x)
                x = nn.relu(LayerNorm(name=f"norm_{level}")(x))
            maps.append(x)
        return maps


class StemDecoder(nn.Module):
    """From tokens to pixels, past the stem's maps: double the resolution, look at the map there, convolve."""

    patch: int
    circular: bool = False

    @nn.compact
    def __call__(self, tokens: Float[Array, "b h w c"], maps: Sequence[Array]) -> Float[Array, "b _ _ _"]:
        """`patch` is the edge of a token in pixels of the coarsest map. As many channels as the finest map has."""
        x, factor = tokens, self.patch
        for level in reversed(range(len(maps))):
            width = maps[level].shape[-1]
            x = FinalPatchExpand(factor, width, name=f"expand_{level}")(x)
            x = jnp.concatenate([x, maps[level]], axis=-1)
            x = nn.relu(Convolution(width, circular=self.circular, name=f"convolution_{level}")(x))
            factor = 2
        return x
