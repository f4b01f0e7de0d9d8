"""What a place head without a backbone reads (table 6: RB, RS and RB+RS)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sglpr_jax.models.backbones.swin_layers import PatchEmbed
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.input_image import backbone_view


def raw_input(
    image: Float[Array, "b h w c"], labels: Int[Array, "b h w"] | None, config: ModelConfig
) -> Float[Array, "b p q _"]:
    """Planes of point counts, of labels (one for each class), or both, in place of features.

    A polar model resamples the planes bilinearly, so that a polar pixel holds the share of each class. A head made for
    tokens reads them through a patch embedding, a layer of the module that calls this; one made for pixels as they are.
    """
    planes = [image] if config.head.reads_counts else []
    if config.head.reads_labels:
        planes.append(jax.nn.one_hot(labels, config.classes))
    x = backbone_view(jnp.concatenate(planes, axis=-1), config)
    if config.head.tap == "pixels":
        return x
    return PatchEmbed(config.backbone.width, config.backbone.token, name="patch_embed")(x)
