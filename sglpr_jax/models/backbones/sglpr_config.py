"""Configuration of the Swin-Unet on the tokens of the circular CNN."""

import dataclasses
from typing import Literal

from sglpr_jax.fields import Depths, Share, Size, Sizes, check_fields
from sglpr_jax.models.backbones.circular_config import CircularConfig
from sglpr_jax.models.backbones.swin_config import check_stages


@dataclasses.dataclass(frozen=True)
class SglprConfig:
    """Swin-Unet whose tokens come from circular convolutions on the polar image."""

    kind: Literal["sglpr"] = "sglpr"
    stem: CircularConfig = CircularConfig(fine=(14,), widths=(16, 32, 64), strides=(2, 2, 1), means=(1, 1, 2))
    """Circular CNN that makes the tokens. Its last map has one pixel for each token."""
    embed_dim: Size = 64
    depths: Depths = (2, 2)
    """Number of blocks of each stage."""
    heads: Sizes = (2, 4)
    """Number of attention heads of each stage."""
    window: Size = 4
    """Edge of an attention window, in tokens."""
    mlp_ratio: Size = 2
    """Hidden units of a block's MLP per channel; 4 in the paper."""
    drop_path: Share = 0.0
    """Stochastic depth: fraction of samples for which training skips the last block. It rises from 0 at the first
    block."""

    def __post_init__(self):
        check_fields(self)
        check_stages(self.embed_dim, self.depths, self.heads)

    @property
    def token(self) -> tuple[int, int]:
        """Rows and columns of the polar image that one token represents."""
        return self.stem.token

    @property
    def width(self) -> int:
        """Channels of the tokens."""
        return self.embed_dim

    @property
    def multiple(self) -> tuple[int, int]:
        """The image's rows and columns must be a multiple of this, the size of one token of the coarsest stage."""
        rows, columns = self.token
        coarsest = 2 ** (len(self.depths) - 1)
        return rows * coarsest, columns * coarsest

    @property
    def needs_polar(self) -> bool:
        """Always True: the convolutions and windows wrap around."""
        return True

    @property
    def pictures(self) -> dict[str, str]:
        """Maps to draw as heat maps: the stem, the first and last stage of the encoder, and the decoder."""
        stem, last = len(self.stem.widths) - 1, len(self.depths) - 1
        return {
            "stem": f"circular_block{stem}",
            "encoder, first": "enc0_out",
            "encoder, last": f"enc{last}_out",
            "decoder": f"dec{last}_out",
        }
