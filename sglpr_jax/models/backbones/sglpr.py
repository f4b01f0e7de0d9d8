"""The paper's Swin-Unet on tokens that a rotation of the scan shifts: its patches are seen by circular convolutions.

A patch of eight sectors feels a rotation by less than its size, a convolution does not; so the stem shrinks the polar
image as the ring net does, and the windows work on what is left. A rotation by a whole number of windows of the
coarsest map is a shift of the tokens; other rotations are learnt.
"""

import dataclasses
from typing import Literal

import flax.linen as nn
from jaxtyping import Array, Float

from sglpr_jax.fields import Depths, Share, Size, Sizes, check_fields
from sglpr_jax.models.backbones.interface import Seen
from sglpr_jax.models.backbones.rings import RingConfig, RingDecoder, RingNet
from sglpr_jax.models.backbones.swin_layers import check_stages
from sglpr_jax.models.backbones.swin_unet import SwinUnet


@dataclasses.dataclass(frozen=True)
class SglprConfig:
    """A Swin-Unet whose tokens come from convolutions that go around the polar image."""

    kind: Literal["sglpr"] = "sglpr"
    stem: RingConfig = RingConfig(fine=(14,), widths=(16, 32, 64), strides=(2, 2, 1), means=(1, 1, 2))
    """Its last map has a pixel for each token."""
    embed_dim: Size = 64
    depths: Depths = (2, 2)
    """Blocks of each stage."""
    heads: Sizes = (2, 4)
    """Attention heads of each stage."""
    window: Size = 4
    """Edge of an attention window, in tokens."""
    mlp_ratio: Size = 2
    """Of the hidden layer of a block's MLP to its channels; 4 in the paper."""
    drop_path: Share = 0.0
    """Stochastic depth: the share of samples for which training leaves the last block out; 0 for the first block."""

    def __post_init__(self):
        check_fields(self)
        check_stages(self.embed_dim, self.depths, self.heads)

    @property
    def token(self) -> tuple[int, int]:
        """Rows and columns of the polar image that one token stands for."""
        return self.stem.token

    @property
    def width(self) -> int:
        """Channels of the tokens."""
        return self.embed_dim

    @property
    def multiple(self) -> tuple[int, int]:
        """The image's rows and columns must be a multiple of this: one token of the coarsest stage."""
        rows, columns = self.token
        coarsest = 2 ** (len(self.depths) - 1)
        return rows * coarsest, columns * coarsest

    @property
    def needs_polar(self) -> bool:
        """Its convolutions and windows go around."""
        return True

    @property
    def pictures(self) -> dict[str, str]:
        """Which maps are drawn: of the stem, the first and last stage of the encoder, and the decoder."""
        stem, last = len(self.stem.widths) - 1, len(self.depths) - 1
        return {
            "stem": f"ring_block{stem}",
            "encoder, first": "enc0_out",
            "encoder, last": f"enc{last}_out",
            "decoder": f"dec{last}_out",
        }

    def build(self, *, circular: bool) -> "SglprBackbone":
        """The layers."""
        return SglprBackbone(self)


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
