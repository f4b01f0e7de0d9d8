"""The paper's Swin-Unet as plain values."""

import dataclasses
from typing import Literal

from sglpr_jax.fields import Depths, Share, Size, Sizes, check_fields


@dataclasses.dataclass(frozen=True)
class SwinConfig:
    """A Swin-Unet. The default is the paper's; stage i has `embed_dim` * 2**i channels."""

    kind: Literal["swin"] = "swin"
    patch: Size = 4
    """Edge of a token's patch, in pixels of the image."""
    stem: Sizes = ()
    """Widths of convolutions before the patch embedding, the second and later ones at half the resolution of the one
    before; the segmentation head sees each of them again. (): none, as in the paper."""
    embed_dim: Size = 96
    depths: Depths = (2, 2, 2, 2)
    """Blocks of each stage."""
    heads: Sizes = (3, 6, 12, 24)
    """Attention heads of each stage."""
    window: Size = 7
    """Edge of an attention window, in tokens."""
    drop_path: Share = 0.2
    """Stochastic depth: the share of samples for which training leaves the last block out; 0 for the first block."""

    def __post_init__(self):
        check_fields(self)
        check_stages(self.embed_dim, self.depths, self.heads)
        if self.patch % self._stem_pixel:
            raise ValueError(
                f"expected a patch made of the stem's pixels of {self._stem_pixel} cells ({len(self.stem)} widths), "
                f"found patch {self.patch}"
            )

    @property
    def token(self) -> tuple[int, int]:
        """Rows and columns of the image that one token stands for."""
        return self.patch, self.patch

    @property
    def width(self) -> int:
        """Channels of the tokens."""
        return self.embed_dim

    @property
    def multiple(self) -> tuple[int, int]:
        """The image's rows and columns must be a multiple of this: one token of the coarsest stage."""
        return (self.patch * 2 ** (len(self.depths) - 1),) * 2

    @property
    def needs_polar(self) -> bool:
        """Windows fit any image."""
        return False

    @property
    def pictures(self) -> dict[str, str]:
        """Which maps are drawn; a normalised one would be as strong everywhere."""
        last = len(self.depths) - 1
        return {"encoder, first": "enc0_out", "encoder, last": f"enc{last}_out", "decoder": f"dec{last}_out"}

    @property
    def stem_patch(self) -> int:
        """Edge of a token's patch in pixels of the map that it is cut from: the image, or the stem's last map."""
        return self.patch // self._stem_pixel

    @property
    def _stem_pixel(self) -> int:
        return 2 ** max(len(self.stem) - 1, 0)


def check_stages(embed_dim: int, depths: tuple[int, ...], heads: tuple[int, ...]) -> None:
    """Raise ValueError unless there are as many numbers of heads as of blocks, and heads that share a stage's channels.

    Stage i has `embed_dim` * 2**i channels.
    """
    if not depths or len(depths) != len(heads):
        raise ValueError(
            f"expected a stage at least, and a number of heads for each, found depths {depths}, heads {heads}"
        )
    for i, number in enumerate(heads):
        if embed_dim * 2**i % number:
            raise ValueError(
                f"heads: expected a divisor of the {embed_dim * 2**i} channels of stage {i}, found {number}"
            )
