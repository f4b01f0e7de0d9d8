"""The ring net as plain values."""

import dataclasses
import math
from typing import Literal

from sglpr_jax.fields import Size, Sizes, check_fields


@dataclasses.dataclass(frozen=True)
class RingConfig:
    """Convolutions that go around the polar image, a block of them for each width."""

    kind: Literal["rings"] = "rings"
    average: Size = 2
    """Edge of the squares of polar pixels whose means the first block sees: without, the resampling skips cells."""
    fine: Sizes = ()
    """Channels of more blocks, which see the polar pixels themselves: the i-th joins what the i-th of `widths` sees."""
    widths: Sizes = (16, 32, 64, 96, 128, 160, 160)
    """Channels of each block."""
    strides: Sizes = (2, 2, 1, 2, 1, 1, 1)
    """Of each block, along the radius."""
    means: Sizes = (1, 1, 2, 1, 2, 1, 1)
    """How many neighbouring sectors become one after each block."""

    def __post_init__(self):
        check_fields(self)
        if not self.widths:
            raise ValueError("widths: expected at least one block, found ()")
        if not len(self.widths) == len(self.strides) == len(self.means):
            raise ValueError(
                "expected as many strides and means as widths of the ring net, found "
                f"widths {self.widths}, strides {self.strides}, means {self.means}"
            )
        if len(self.fine) > len(self.widths):
            raise ValueError(
                f"fine: expected no more than the widths of the ring net, {self.widths}, found {self.fine}"
            )

    @property
    def token(self) -> tuple[int, int]:
        """Rows and columns of the polar image that one pixel of the last map stands for."""
        return self.average * math.prod(self.strides), self.average * math.prod(self.means)

    @property
    def width(self) -> int:
        """Channels of the last map."""
        return self.widths[-1]

    @property
    def multiple(self) -> tuple[int, int]:
        """The image's rows and columns must be a multiple of this: one pixel of the last map."""
        return self.token

    @property
    def needs_polar(self) -> bool:
        """Its convolutions go around."""
        return True

    @property
    def pictures(self) -> dict[str, str]:
        """Which maps are drawn: of the first, the middle and the last block."""
        last = len(self.widths) - 1
        return {f"block {i + 1}": f"ring_block{i}" for i in sorted({0, last // 2, last})}
