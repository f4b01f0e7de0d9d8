"""The paper's Swin-Unet on tokens of circular convolutions, which a rotation of the scan only shifts.

A patch of eight sectors changes under rotations smaller than the patch. The result of a convolution shifts with such
rotations. Therefore the stem reduces the polar image like the circular CNN, and the attention windows use the resulting
tokens. A rotation by a whole number of windows of the coarsest map is a shift of the tokens. Other rotations must be
learnt.
"""

import dataclasses

import flax.linen as nn
from jaxtyping import Array, Float

from sglpr_jax.models.backbone import Seen
from sglpr_jax.models.circular import CircularDecoder, CircularNet
from sglpr_jax.models.config import SglprConfig
from sglpr_jax.models.swin_unet import SwinUnet


@dataclasses.dataclass(frozen=True)
class SglprBackbone:
    """Swin-Unet with a stem, and a decoder that uses the stem's maps: layers `backbone` and `decoder`."""

    config: SglprConfig

    def __call__(self, image: Float[Array, "b p q c"], *, train: bool) -> Seen:
        """Computes the tokens and the maps of the stem. The tokens replace the last map."""
        return CircularSwin(self.config, name="backbone")(image, train=train)

    def decode(self, seen: Seen) -> Float[Array, "b _ _ _"]:
        """Computes a pixel for each pixel of the averaged image."""
        return CircularDecoder(self.config.stem.widths, name="decoder")([*seen.finer, seen.features])


class CircularSwin(nn.Module):
    """Network from the polar image to a token for each pixel of the stem's last map."""

    config: SglprConfig

    @nn.compact
    def __call__(self, polar: Float[Array, "b p q c"], *, train: bool = False) -> Seen:
        """Returns the tokens as features. The maps are named as in the circular CNN and the Swin-Unet."""
        config = self.config
        maps = CircularNet(config.stem, name="stem")(polar)
        tokens, named = SwinUnet(
            embed_dim=config.embed_dim,
            depths=config.depths,
            heads=config.heads,
            window=config.window,
            mlp_ratio=config.mlp_ratio,
            patch=1,
            drop_path=config.drop_path,
            circular=True,
            shift_each_way=True,
            name="swin_unet",
        )(maps[-1], train=train)
        return Seen(tokens, maps[:-1], {f"circular_block{i}": x for i, x in enumerate(maps[1:])} | named)
