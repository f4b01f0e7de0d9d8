"""Backbone of circular convolutions on the polar image: a rotation of the scan only shifts its features.

Along the radius, strides reduce the image, because a rotation moves nothing in this direction. Along the sectors,
average pooling reduces it, because pooling skips no sector. A rotation by a whole number of the last map's sectors is
therefore a shift of that map. It is exact up to the resampling of the image.
"""

import functools
import itertools

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.backbone_config import CircularConfig
from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.layers import LayerNorm, Linear


class CircularBlock(nn.Module):
    """Circular convolution, layer norm, ReLU. If input and output have the same shape, the input is added."""

    features: int
    stride: int = 1
    """Stride along the radius."""

    @nn.compact
    def __call__(self, x: Float[Array, "b r s c"]) -> Float[Array, "b _ s {self.features}"]:
        convolution = Convolution(self.features, strides=(self.stride, 1), circular=True, name="convolution")
        y = nn.relu(LayerNorm(name="norm")(convolution(x)))
        return x + y if x.shape == y.shape else y


class CircularNet(nn.Module):
    """Network from the polar image to the features of the place head and all intermediate maps.

    Average pooling loses details that are smaller than its window. Therefore, a second branch of blocks keeps all
    sectors. Each of its maps is averaged to the size of a map of the main branch, to which it is joined.
    """

    config: CircularConfig

    @nn.compact
    def __call__(self, polar: Float[Array, "b p q c"]) -> list[Float[Array, "b _ _ _"]]:
        """Returns the averaged image and the map of each block, with the fine maps. The last map is the features."""
        config, fine = self.config, polar
        maps = [block_means(polar, config.average, config.average)]
        for i, (width, stride, sectors) in enumerate(zip(config.widths, config.strides, config.means, strict=True)):
            if i < len(config.fine):
                stride_of_fine = config.strides[i - 1] if i else config.average
                fine = CircularBlock(config.fine[i], stride_of_fine, name=f"fine_{i}")(fine)
                averaged = block_means(fine, 1, fine.shape[2] // maps[-1].shape[2])
                maps[-1] = jnp.concatenate([maps[-1], averaged], axis=-1)
            maps.append(block_means(CircularBlock(width, stride, name=f"block_{i}")(maps[-1]), 1, sectors))
        return maps


class CircularDecoder(nn.Module):
    """Decoder from the features to the resolution of the image after average pooling.

    At each finer resolution it joins the last map that the network computed there (skip connection).
    """

    widths: tuple[int, ...]
    """Channels of the blocks that made the maps."""

    @nn.compact
    def __call__(self, maps: list[Array]) -> Float[Array, "b p q _"]:
        """Returns pixels with the channels of the first block."""
        skips = [i for i, (fine, coarse) in enumerate(itertools.pairwise(maps)) if fine.shape[:3] != coarse.shape[:3]]
        x = maps[-1]
        for i, row in enumerate(reversed(skips)):
            skip, width = maps[row], self.widths[max(row - 1, 0)]
            x = Linear(width, name=f"narrow_{i}")(x)
            x = x.repeat(skip.shape[1] // x.shape[1], axis=1).repeat(skip.shape[2] // x.shape[2], axis=2)
            x = CircularBlock(width, name=f"block_{i}")(jnp.concatenate([x, skip], axis=-1))
        return x


def block_means(x: Float[Array, "b r s c"], radii: int, sectors: int) -> Float[Array, "b _ _ c"]:
    """Average blocks of `radii` x `sectors` pixels, one direction after the other, so that no array has six axes."""
    b, r, s, c = x.shape
    rows = _mean_of_parts(x.reshape(b, r // radii, radii * s * c), radii)
    blocks = _mean_of_parts(rows.reshape(b, r // radii * (s // sectors), sectors * c), sectors)
    return blocks.reshape(b, r // radii, s // sectors, c)


def _mean_of_parts(x: Float[Array, "b n k"], parts: int) -> Float[Array, "b n _"]:
    """Average equal parts of each row. They are added, because XLA's CPU backend reduces a few numbers slowly."""
    if parts == 1:
        return x
    return functools.reduce(jnp.add, jnp.split(x, parts, axis=-1)) * (1 / parts)
