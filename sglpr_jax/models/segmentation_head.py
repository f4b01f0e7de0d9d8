"""Segmentation head: logits on the grid, from the decoder's pixels and the image."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.initial import lecun_normal, torch_uniform
from sglpr_jax.models.input_image import from_polar
from sglpr_jax.models.layers import Linear, gelu

_IMAGE_CONVOLUTIONS = ((5, 16), (3, 16))
"""Kernel size in cells, and channels, of the convolutions of the image. Together they see three cells to each side."""


class Detail(nn.Module):
    """Mixes the features of every cell with the image around it, because a token of many cells blurs their counts."""

    width: int
    """Channels of the result."""

    @nn.compact
    def __call__(self, features: Float[Array, "b h w c"], image: Float[Array, "b h w i"]) -> Float[Array, "b h w _"]:
        surroundings = image.astype(features.dtype)
        for i, (size, channels) in enumerate(_IMAGE_CONVOLUTIONS):
            convolution = Convolution(channels, size, kernel_init=lecun_normal, name=f"local{i}")
            surroundings = nn.relu(convolution(surroundings))
        return gelu(Linear(self.width, name="mix")(jnp.concatenate([features, surroundings], axis=-1)))


def segmentation_head(
    pixels: Float[Array, "b p q c"], image: Float[Array, "b h w i"], config: ModelConfig
) -> Float[Array, "b h w {config.classes}"]:
    """Compute logits on the grid from the decoder's pixels and the prepared image, in layers of the calling module.

    A linear layer comes first, so that few channels are resampled from the polar image to the grid. It gives the
    logits, or with `config.detail` features that `Detail` mixes with the image.
    """
    to_logits = Linear(config.classes, use_bias=False, kernel_init=torch_uniform, name="segmentation_head")
    narrow = Linear(config.detail, name="narrow")(pixels) if config.detail else to_logits(pixels)
    on_grid = narrow.astype(jnp.float32)
    if config.polar:
        on_grid = from_polar(on_grid, config.grid)
    if not config.detail:
        return on_grid
    detailed = Detail(config.detail, name="detail")(on_grid.astype(config.compute), image)
    return to_logits(detailed).astype(jnp.float32)
