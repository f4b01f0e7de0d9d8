"""The Swin-Unet on the tokens of the ring net, as plain values."""

import dataclasses
from typing import Literal

from sglpr_jax.fields import Depths, Share, Size, Sizes, check_fields
from sglpr_jax.models.backbones.rings_config import RingConfig
from sglpr_jax.models.backbones.swin_config import check_stages


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
