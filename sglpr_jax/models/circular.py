"""Circular convolutions on the polar image: a rotation of the scan only shifts its features.

Strides reduce the radius, along which a rotation moves nothing. Average pooling reduces the sectors, because it skips
none. A rotation by whole sectors of the last map therefore shifts this map, exactly up to the resampling of the image.
"""

import functools

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

    Average pooling loses small details. With `config.fine`, a second branch of blocks keeps all sectors. Each of its
    maps is averaged to the size of a map of the main branch, whose channels it extends.
    """

    config: CircularConfig

    @nn.compact
    def __call__(self, polar: Float[Array, "b p q c"]) -> list[Float[Array, "b _ _ _"]]:
        """Return the averaged image and the map of each block. The last map holds the features."""
        config = self.config
        fine_map = polar
        maps = [block_means(polar, config.average, config.average)]
        for i, (width, stride, sectors) in enumerate(zip(config.widths, config.strides, config.means, strict=True)):
            if i < len(config.fine):
                # The same stride along the radius as the main branch had to reach `maps[-1]`.
                fine_stride = config.average if i == 0 else config.strides[i - 1]
                fine_map = CircularBlock(config.fine[i], fine_stride, name=f"fine_{i}")(fine_map)
                averaged = block_means(fine_map, 1, fine_map.shape[2] // maps[-1].shape[2])
                maps[-1] = jnp.concatenate([maps[-1], averaged], axis=-1)
            block = CircularBlock(width, stride, name=f"block_{i}")(maps[-1])
            maps.append(block_means(block, 1, sectors))
        return maps


class CircularDecoder(nn.Module):
    """Decoder to the size of the averaged image. At each finer size, the last map of `CircularNet` with it joins."""

    widths: tuple[int, ...]
    """Channels of the blocks of `CircularNet`."""

    @nn.compact
    def __call__(self, maps: list[Array]) -> Float[Array, "b p q _"]:
        """Return pixels, given the averaged image and the maps of the blocks of `CircularNet`."""
        last_of_each_resolution = [i for i in range(len(maps) - 1) if maps[i].shape[:3] != maps[i + 1].shape[:3]]
        x = maps[-1]
        for step, i in enumerate(reversed(last_of_each_resolution)):
            skip, width = maps[i], self.widths[max(i - 1, 0)]  # map i comes from block i - 1, map 0 is the image
            x = Linear(width, name=f"narrow_{step}")(x)
            x = x.repeat(skip.shape[1] // x.shape[1], axis=1).repeat(skip.shape[2] // x.shape[2], axis=2)
            x = CircularBlock(width, name=f"block_{step}")(jnp.concatenate([x, skip], axis=-1))
        return x


def block_means(x: Float[Array, "b r s c"], radii: int, sectors: int) -> Float[Array, "b _ _ c"]:
    """Average blocks of `radii` x `sectors` pixels. Radii come first, then sectors, so that no array has six axes."""
    b, r, s, c = x.shape
    if r % radii or s % sectors:
        raise ValueError(f"means: expected a polar map that {radii} x {sectors} pixels tile, found {r} x {s} pixels")
    over_radii = _mean_of_parts(x.reshape(b, r // radii, radii * s * c), radii)
    blocks = _mean_of_parts(over_radii.reshape(b, r // radii * (s // sectors), sectors * c), sectors)
    return blocks.reshape(b, r // radii, s // sectors, c)


def _mean_of_parts(x: Float[Array, "b n k"], parts: int) -> Float[Array, "b n _"]:
    """Split the last axis into equal parts and average them by additions, which are faster on a CPU than a mean."""
    if parts == 1:
        return x
    return functools.reduce(jnp.add, jnp.split(x, parts, axis=-1)) * (1 / parts)
