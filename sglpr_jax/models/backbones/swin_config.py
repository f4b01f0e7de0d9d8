"""Configuration of the paper's Swin-Unet."""

import dataclasses
from typing import Literal

from sglpr_jax.fields import Depths, Share, Size, Sizes, check_fields


@dataclasses.dataclass(frozen=True)
class SwinConfig:
    """Swin-Unet with the paper's values as defaults. Stage i has `embed_dim` * 2**i channels."""

    kind: Literal["swin"] = "swin"
    patch: Size = 4
    """Edge of a token's patch, in pixels of the image."""
    embed_dim: Size = 96
    depths: Depths = (2, 2, 2, 2)
    """Number of blocks of each stage."""
    heads: Sizes = (3, 6, 12, 24)
    """Number of attention heads of each stage."""
    window: Size = 7
    """Edge of an attention window, in tokens."""
    drop_path: Share = 0.2
    """Stochastic depth: fraction of samples for which training skips the last block. It rises from 0 at the first
    block."""

    def __post_init__(self):
        check_fields(self)
        check_stages(self.embed_dim, self.depths, self.heads)

    @property
    def token(self) -> tuple[int, int]:
        """Rows and columns of the image that one token represents."""
        return self.patch, self.patch

    @property
    def width(self) -> int:
        """Channels of the tokens."""
        return self.embed_dim

    @property
    def multiple(self) -> tuple[int, int]:
        """The image's rows and columns must be a multiple of this, the size of one token of the coarsest stage."""
        return (self.patch * 2 ** (len(self.depths) - 1),) * 2

    @property
    def needs_polar(self) -> bool:
        """Always False: windows fit any image."""
        return False

    @property
    def pictures(self) -> dict[str, str]:
        """Maps to draw as heat maps. Normalised maps are left out, because they have the same strength everywhere."""
        last = len(self.depths) - 1
        return {"encoder, first": "enc0_out", "encoder, last": f"enc{last}_out", "decoder": f"dec{last}_out"}


def check_stages(embed_dim: int, depths: tuple[int, ...], heads: tuple[int, ...]) -> None:
    """Raises ValueError unless each stage has blocks and a number of heads that divides its channels.

    Stage i has `embed_dim` * 2**i channels.
    """
    if not depths or len(depths) != len(heads):
        raise ValueError(
            f"expected at least one stage, and a number of heads for each, found depths {depths}, heads {heads}"
        )
    for i, number in enumerate(heads):
        if embed_dim * 2**i % number:
            raise ValueError(
                f"heads: expected a divisor of the {embed_dim * 2**i} channels of stage {i}, found {number}"
            )
