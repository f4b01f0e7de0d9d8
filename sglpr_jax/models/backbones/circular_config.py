"""Configuration of the circular CNN."""

import dataclasses
import math
from typing import Literal

from sglpr_jax.fields import Size, Sizes, check_fields


@dataclasses.dataclass(frozen=True)
class CircularConfig:
    """Circular convolutions on the polar image, with one block for each width."""

    kind: Literal["circular"] = "circular"
    average: Size = 2
    """Edge of the squares of polar pixels that are averaged before the first block. Without averaging, the resampling
    skips cells."""
    fine: Sizes = ()
    """Channels of additional blocks at the full number of sectors. The output of the i-th joins the input of the i-th
    block of `widths`."""
    widths: Sizes = (16, 32, 64, 96, 128, 160, 160)
    """Channels of each block."""
    strides: Sizes = (2, 2, 1, 2, 1, 1, 1)
    """Stride of each block along the radius."""
    means: Sizes = (1, 1, 2, 1, 2, 1, 1)
    """Number of neighbouring sectors that are averaged into one after each block."""

    def __post_init__(self):
        check_fields(self)
        if not self.widths:
            raise ValueError("widths: expected at least one block, found ()")
        if not len(self.widths) == len(self.strides) == len(self.means):
            raise ValueError(
                "expected equal numbers of widths, strides and means of the circular CNN, found "
                f"widths {self.widths}, strides {self.strides}, means {self.means}"
            )
        if len(self.fine) > len(self.widths):
            raise ValueError(
                f"fine: expected at most one value for each width of the circular CNN, {self.widths}, found {self.fine}"
            )

    @property
    def token(self) -> tuple[int, int]:
        """Rows and columns of the polar image that one pixel of the last map represents."""
        return self.average * math.prod(self.strides), self.average * math.prod(self.means)

    @property
    def width(self) -> int:
        """Channels of the last map."""
        return self.widths[-1]

    @property
    def multiple(self) -> tuple[int, int]:
        """Numbers that must divide the rows and columns of the image: how many of its pixels one pixel of the last map
        covers."""
        return self.token

    @property
    def needs_polar(self) -> bool:
        """Always True: the convolutions are circular."""
        return True

    @property
    def pictures(self) -> dict[str, str]:
        """Maps to draw as heat maps: those of the first, the middle and the last block."""
        last = len(self.widths) - 1
        return {f"block {i + 1}": f"circular_block{i}" for i in sorted({0, last // 2, last})}
