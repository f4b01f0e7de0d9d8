"""Configurations of the backbones: Swin-Unet, and a Swin-Unet on the tokens of a circular CNN.

Each has these properties:
* `token`: rows and columns of the image that one feature represents.
* `width`: channels of the features.
* `multiple`: the rows and columns of the image must be multiples of it, the size of one feature of the coarsest map.
* `needs_polar`: whether the backbone requires a polar image, because its columns wrap around.
* `pictures`: maps to draw as heat maps, from the title of each picture to a name in `Outputs.intermediates`.
"""

import abc
import dataclasses
import math
from typing import Literal

from sglpr_jax.fields import Depths, Share, Size, Sizes, check_fields


def check_lengths(owner: str, **lists: tuple[int, ...]) -> None:
    """Raise ValueError if the fields of `owner`, for example `widths=(16, 32)`, have different lengths."""
    lengths = {len(entries) for entries in lists.values()}
    if len(lengths) > 1:
        *names, last_name = lists
        found = ", ".join(f"{name} {entries}" for name, entries in lists.items())
        raise ValueError(f"expected equal numbers of {', '.join(names)} and {last_name} of {owner}, found {found}")


class _SwinStages(abc.ABC):
    """Properties and checks of `SwinConfig` and `SglprConfig`. Stage i has `embed_dim` * 2**i channels."""

    embed_dim: int
    depths: tuple[int, ...]
    heads: tuple[int, ...]
    fewest_stages = 1

    def __post_init__(self):
        check_fields(self)
        if len(self.depths) < self.fewest_stages or len(self.depths) != len(self.heads):
            found = f"depths {self.depths}, heads {self.heads}"
            expected = f"{self.fewest_stages} or more stages, and a number of heads for each"
            raise ValueError(f"expected {expected}, found {found}")
        for i, heads in enumerate(self.heads):
            channels = self.embed_dim * 2**i
            if channels % heads:
                raise ValueError(f"heads: expected a divisor of the {channels} channels of stage {i}, found {heads}")

    @property
    @abc.abstractmethod
    def token(self) -> tuple[int, int]:
        """Rows and columns of the image that one token represents."""

    @property
    def width(self) -> int:
        return self.embed_dim

    @property
    def multiple(self) -> tuple[int, int]:
        tokens_per_feature = 2 ** max(len(self.depths) - 1, 0)  # along rows and columns of the last stage
        return self.token[0] * tokens_per_feature, self.token[1] * tokens_per_feature

    @property
    def pictures(self) -> dict[str, str]:
        last = len(self.depths) - 1
        # The maps before the last layer norm, which makes all positions equally strong.
        return {"encoder, first": "enc0_out", "encoder, last": f"enc{last}_out", "decoder": f"dec{last}_out"}


@dataclasses.dataclass(frozen=True)
class SwinConfig(_SwinStages):
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
    """Stochastic depth: fraction of samples that skip the last block in training. It is 0 for the first block."""

    mlp_ratio = 4
    needs_polar = False

    @property
    def token(self) -> tuple[int, int]:
        return self.patch, self.patch


@dataclasses.dataclass(frozen=True)
class CircularConfig:
    """Circular convolutions on the polar image, with one block for each width."""

    average: Size = 2
    """Edge of the squares of polar pixels that are averaged first, because a smaller polar image would skip cells."""
    fine: Sizes = (14,)
    """Channels of additional blocks at the full number of sectors. Each joins the input of the block in `widths`."""
    widths: Sizes = (16, 32, 64)
    """Channels of each block."""
    strides: Sizes = (2, 2, 1)
    """Stride of each block along the radius."""
    means: Sizes = (1, 1, 2)
    """Number of neighbouring sectors that are averaged into one after each block."""

    def __post_init__(self):
        check_fields(self)
        if not self.widths:
            raise ValueError("widths: expected at least one block, found ()")
        check_lengths("the circular CNN", widths=self.widths, strides=self.strides, means=self.means)
        if len(self.fine) > len(self.widths):
            raise ValueError(
                f"fine: expected at most one value for each width of the circular CNN, {self.widths}, found {self.fine}"
            )

    @property
    def token(self) -> tuple[int, int]:
        """Rows and columns of the image that one pixel of the last map represents."""
        return self.average * math.prod(self.strides), self.average * math.prod(self.means)


@dataclasses.dataclass(frozen=True)
class SglprConfig(_SwinStages):
    """Swin-Unet whose tokens come from circular convolutions on the polar image."""

    kind: Literal["sglpr"] = "sglpr"
    stem: CircularConfig = CircularConfig()
    """Circular CNN that makes the tokens. Its last map has one pixel for each token. `fine` are the widths of
    additional blocks at full resolution, and `means` the numbers of sectors averaged into one after each block."""
    embed_dim: Size = 64
    depths: Depths = (2, 2)
    """Number of blocks of each stage. (): no stages, so that the tokens of the stem are the features."""
    heads: Sizes = (2, 4)
    """Number of attention heads of each stage."""
    window: Size = 4
    """Edge of an attention window, in tokens."""
    mlp_ratio: Size = 2
    """Hidden units of a block's MLP per channel; 4 in the paper."""
    drop_path: Share = 0.0
    """Stochastic depth: fraction of samples that skip the last block in training. It is 0 for the first block."""

    needs_polar = True
    fewest_stages = 0

    @property
    def token(self) -> tuple[int, int]:
        return self.stem.token

    @property
    def width(self) -> int:
        return self.embed_dim if self.depths else self.stem.widths[-1]

    @property
    def pictures(self) -> dict[str, str]:
        stem = {"stem": f"circular_block{len(self.stem.widths) - 1}"}
        return stem | super().pictures if self.depths else stem


BackboneConfig = SwinConfig | SglprConfig
