"""Convolutions in front of the Swin-Unet, and a decoder from its tokens to pixels that uses their maps.

A linear patch embedding must recognise the side of a car in one layer; convolutions recognise it step by step. The
tokens lose the detail of the intermediate maps, so the segmentation head uses these maps again.
"""

from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.backbones.swin_layers import FinalPatchExpand
from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.layers import LayerNorm


class Stem(nn.Module):
    """3 x 3 convolutions with `widths` channels: one at the resolution of the image, two at each coarser resolution."""

    widths: tuple[int, ...]
    circular: bool = False

    @nn.compact
    def __call__(self, image: Float[Array, "b h w c"]) -> list[Float[Array, "b _ _ _"]]:
        """Returns the map of each resolution, finest first."""
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
    """Decoder from tokens to pixels: at each level it expands the map, joins the stem's map and convolves."""

    patch: int
    circular: bool = False

    @nn.compact
    def __call__(self, tokens: Float[Array, "b h w c"], maps: Sequence[Array]) -> Float[Array, "b _ _ _"]:
        """Returns pixels with the finest map's channels. `patch` is a token's edge in pixels of the coarsest map."""
        x, factor = tokens, self.patch
        for level in reversed(range(len(maps))):
            width = maps[level].shape[-1]
            x = FinalPatchExpand(factor, width, name=f"expand_{level}")(x)
            x = jnp.concatenate([x, maps[level]], axis=-1)
            x = nn.relu(Convolution(width, circular=self.circular, name=f"convolution_{level}")(x))
            factor = 2
        return x
