"""Segmentation head: logits on the grid, from the decoder's pixels and the image."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.convolution import Convolution
from sglpr_jax.models.initial import lecun_normal, torch_uniform
from sglpr_jax.models.input_image import from_polar
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
        return gelu(Linear(self.width, name="mix")(jnp.concatenate([features, image], axis=-1)))


def segmentation_head(
    pixels: Float[Array, "b p q c"], image: Float[Array, "b h w i"], config: ModelConfig
) -> Float[Array, "b h w {config.classes}"]:
    """Compute logits on the grid from the decoder's pixels and the prepared image.

    The layers belong to the calling module. A linear layer comes first, so that few channels are resampled from the
    polar image to the grid. The resampling and the logits are float32.
    """
    to_logits = Linear(config.classes, use_bias=False, kernel_init=torch_uniform, name="segmentation_head")
    narrow = Linear(config.detail, name="narrow")(pixels) if config.detail else to_logits(pixels)
    on_grid = narrow.astype(jnp.float32)
    on_grid = from_polar(on_grid, config.grid) if config.polar else on_grid
    if not config.detail:
        return on_grid
    detailed = Detail(config.detail, name="detail")(on_grid.astype(config.compute), image)
    return to_logits(detailed).astype(jnp.float32)
