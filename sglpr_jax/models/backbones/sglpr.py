"""The paper's Swin-Unet on tokens that a rotation of the scan shifts: its patches are seen by circular convolutions.

A patch of eight sectors feels a rotation by less than its size, a convolution does not; so the stem shrinks the polar
image as the ring net does, and the windows work on what is left. A rotation by a whole number of windows of the
coarsest map is a shift of the tokens; other rotations are learnt.
"""

import dataclasses

import flax.linen as nn
from jaxtyping import Array, Float

from sglpr_jax.models.backbones.interface import Seen
from sglpr_jax.models.backbones.rings import RingDecoder, RingNet
from sglpr_jax.models.backbones.sglpr_config import SglprConfig
from sglpr_jax.models.backbones.swin_unet import SwinUnet


@dataclasses.dataclass(frozen=True)
class SglprBackbone:
    """The Swin-Unet with its stem, and the way back past the stem's maps: layers `backbone` and `decoder`."""

    config: SglprConfig

    def __call__(self, image: Float[Array, "b p q c"], *, train: bool) -> Seen:
        """The tokens, and the maps of the stem but its last, whose place they take."""
        return RingSwin(self.config, name="backbone")(image, train=train)

    def decode(self, seen: Seen) -> Float[Array, "b _ _ _"]:
        """A pixel for each pixel of the averaged image."""
        return RingDecoder(self.config.stem.widths, name="decoder")([*seen.finer, seen.features])


class RingSwin(nn.Module):
    """From the polar image to a token for each pixel of the stem's last map."""

    config: SglprConfig

    @nn.compact
    def __call__(self, polar: Float[Array, "b p q c"], *, train: bool = False) -> Seen:
        """Tokens as features; maps are named as those of the ring net and of the Swin-Unet are."""
        config = self.config
        maps = RingNet(config.stem, name="stem")(polar)
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
        return Seen(tokens, maps[:-1], {f"ring_block{i}": x for i, x in enumerate(maps[1:])} | named)
