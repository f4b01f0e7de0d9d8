"""A backbone of convolutions on the polar image that go around: a rotation of the scan shifts its features, no more.

Along the radius the image may shrink by strides, for a rotation moves nothing in that direction; along the sectors it
shrinks by means, which leave no sector out. So a rotation by a whole number of the last map's sectors is a shift of
that map, exact up to the resampling of the image.
"""

import dataclasses
import functools
import itertools

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.backbones.interface import Seen
from sglpr_jax.models.backbones.rings_config import RingConfig
from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.layers import LayerNorm, Linear


@dataclasses.dataclass(frozen=True)
class RingBackbone:
    """The ring net and its decoder: layers `rings` and `decoder`."""

    config: RingConfig

    def __call__(self, image: Float[Array, "b p q c"], *, train: bool) -> Seen:
        """The last map is the features; there is no stochastic depth."""
        maps = RingNet(self.config, name="rings")(image)
        return Seen(maps[-1], maps[:-1], {f"ring_block{i}": seen for i, seen in enumerate(maps[1:])})

    def decode(self, seen: Seen) -> Float[Array, "b _ _ _"]:
        """A pixel for each pixel of the averaged image."""
        return RingDecoder(self.config.widths, name="decoder")([*seen.finer, seen.features])


class RingBlock(nn.Module):
    """Convolution around the sectors, layer norm, ReLU; added to its input where both have the same shape."""

    features: int
    stride: int = 1
    """Along the radius."""

    @nn.compact
    def __call__(self, x: Float[Array, "b r s c"]) -> Float[Array, "b _ s {self.features}"]:
        """A map of the same sectors."""
        convolution = Convolution(self.features, strides=(self.stride, 1), circular=True, name="convolution")
        y = nn.relu(LayerNorm(name="norm")(convolution(x)))
        return x + y if x.shape == y.shape else y


class RingNet(nn.Module):
    """From the polar image to the features of the place head, and to every map on the way.

    Means lose what is smaller than their squares. So fine blocks go beside the others at the full number of sectors,
    and their maps are averaged to the size of those that they join.
    """

    config: RingConfig

    @nn.compact
    def __call__(self, polar: Float[Array, "b p q c"]) -> list[Float[Array, "b _ _ _"]]:
        """The averaged image and the map of each block, with what joins it; the last one is the features."""
        config, fine = self.config, polar
        maps = [block_means(polar, config.average, config.average)]
        for i, (width, stride, sectors) in enumerate(zip(config.widths, config.strides, config.means, strict=True)):
            if i < len(config.fine):
                fine = RingBlock(config.fine[i], config.strides[i - 1] if i else config.average, name=f"fine_{i}")(fine)
                joining = block_means(fine, 1, fine.shape[2] // maps[-1].shape[2])
                maps[-1] = jnp.concatenate([maps[-1], joining], axis=-1)
            maps.append(block_means(RingBlock(width, stride, name=f"block_{i}")(maps[-1]), 1, sectors))
        return maps


class RingDecoder(nn.Module):
    """From the features back to the resolution of the averaged image, looking at every finer map on the way."""

    widths: tuple[int, ...]
    """Of the blocks that made the maps."""

    @nn.compact
    def __call__(self, maps: list[Array]) -> Float[Array, "b p q _"]:
        """As many channels as the first block has."""
        finer = [i for i, (fine, coarse) in enumerate(itertools.pairwise(maps)) if fine.shape[:3] != coarse.shape[:3]]
        x = maps[-1]
        for i, of_map in enumerate(reversed(finer)):
            seen, width = maps[of_map], self.widths[max(of_map - 1, 0)]
            x = Linear(width, name=f"narrow_{i}")(x)
            x = jnp.concatenate([_repeated(x, seen.shape[1] // x.shape[1], seen.shape[2] // x.shape[2]), seen], axis=-1)
            x = RingBlock(width, name=f"block_{i}")(x)
        return x


def block_means(x: Float[Array, "b r s c"], radii: int, sectors: int) -> Float[Array, "b _ _ c"]:
    """The means of blocks of so many radii and sectors, one direction after the other: no array has six axes."""
    b, r, s, c = x.shape
    rows = _means_of_parts(x.reshape(b, r // radii, radii * s * c), radii)
    blocks = _means_of_parts(rows.reshape(b, r // radii * (s // sectors), sectors * c), sectors)
    return blocks.reshape(b, r // radii, s // sectors, c)


def _means_of_parts(x: Float[Array, "b n k"], parts: int) -> Float[Array, "b n _"]:
    """The mean of so many equal parts of each row: a sum, for XLA's CPU backend is slow at reducing a few numbers."""
    if parts == 1:
        return x
    return functools.reduce(jnp.add, jnp.split(x, parts, axis=-1)) * (1 / parts)


def _repeated(x: Float[Array, "b r s c"], radii: int, sectors: int) -> Float[Array, "b _ _ c"]:
    return x.repeat(radii, axis=1).repeat(sectors, axis=2)
