"""Segmentation head, which is used only in training and for pictures (section 4.1.3)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.heads.detail import Detail
from sglpr_jax.models.initial import torch_uniform
from sglpr_jax.models.layers import Linear
from sglpr_jax.models.polar import from_polar


def segmentation_head(
    pixels: Float[Array, "b p q c"], image: Float[Array, "b h w i"], config: ModelConfig
) -> Float[Array, "b h w {config.classes}"]:
    """Compute logits on the grid from the decoder's pixels and the prepared image.

    The layers belong to the calling module. A linear layer comes first, so that few channels are resampled from the
    polar image to the grid. The resampling and the logits are float32.
    """
    to_logits = Linear(config.classes, use_bias=False, kernel_init=torch_uniform, name="segmentation_head")
    crossing = Linear(config.detail, name="narrow")(pixels) if config.detail else to_logits(pixels)
    on_grid = crossing.astype(jnp.float32)
    on_grid = from_polar(on_grid, config.grid) if config.polar else on_grid
    if not config.detail:
        return on_grid
    detailed = Detail(config.detail, name="detail")(on_grid.astype(config.compute), image)
    return to_logits(detailed).astype(jnp.float32)
