"""Input of a place head without a backbone (table 6: RB, RS and RB+RS)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sglpr_jax.models.backbones.swin_layers import PatchEmbed
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.input_image import backbone_view


def raw_input(
    image: Float[Array, "b h w c"], labels: Int[Array, "b h w"] | None, config: ModelConfig
) -> Float[Array, "b p q _"]:
    """Return planes of point counts, of labels (one plane for each class), or of both, in place of features.

    For a polar model the planes are resampled bilinearly, so a polar pixel holds the fraction of each class. A head
    with the tap `tokens` reads the planes through a patch embedding, a layer of the calling module. With the tap
    `pixels` it reads them directly.
    """
    planes = [image] if config.head.reads_counts else []
    if config.head.reads_labels:
        planes.append(jax.nn.one_hot(labels, config.classes))
    x = backbone_view(jnp.concatenate(planes, axis=-1), config)
    if config.head.tap == "pixels":
        return x
    return PatchEmbed(config.backbone.width, config.backbone.token, name="patch_embed")(x)
