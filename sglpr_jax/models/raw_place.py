"""The place head on raw input, without a backbone (table 6: RB, RS and RB+RS)."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.place_head import PlaceHead
from sglpr_jax.models.polar import to_polar
from sglpr_jax.models.swin import PatchEmbed


class RawPlace(nn.Module):
    """Planes of point counts, of labels (one per class), or both; the place head reads them in place of features.

    A polar model resamples the planes bilinearly, so that a polar pixel holds the share of each class. A head made for
    tokens reads the planes through a patch embedding of their own; one made for pixels reads them as they are.
    """

    config: ModelConfig

    @nn.compact
    def __call__(
        self, image: Float[Array, "b h w c"], labels: Int[Array, "b h w"] | None
    ) -> tuple[Float[Array, "b d"], dict[str, Float[Array, "b _ _ _"]]]:
        """Descriptors of prepared images and their maps of classes, and the maps on the way by name."""
        config = self.config
        planes = [] if config.head.input == "labels" else [image]
        if config.head.reads_labels:
            planes.append(jax.nn.one_hot(labels, config.classes))
        x = jnp.concatenate(planes, axis=-1)
        if config.polar:
            x = to_polar(x, config.grid, *config.polar)
        x = x.astype(config.compute)
        if config.head.tap == "tokens":
            x = PatchEmbed(config.embed_dim, config.patch, name="patch_embed")(x)
        return PlaceHead(config.head, config.polar is not None, name="place_head")(x)
