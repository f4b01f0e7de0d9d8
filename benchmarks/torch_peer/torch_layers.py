"""Layers that the PyTorch modules share, each in the form that was the fastest in PyTorch on a CPU.

Maps are (b, h, w, c) throughout. Seen as (b, c, h, w), without a copy, such a map is what PyTorch calls channels-last:
its convolutions and pools take it as it is and give one of the same kind back. The kernels are kept channels-last too
(`torch_reference.from_params`), or every call would reorder them: a step of a convolution took 1.3 times as long.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Convolution(nn.Conv2d):
    """A square convolution with our borders; the columns of a `circular` map go around."""

    def __init__(self, inputs: int, outputs: int, size: int, strides: tuple[int, int] = (1, 1), *, circular: bool):
        border = 0 if strides == (size, size) else size // 2
        super().__init__(inputs, outputs, size, strides, (border, 0 if circular else border))
        self.around = border if circular else 0

    def forward(self, x: Tensor) -> Tensor:
        """`F.pad(mode="circular")` would make the map channels-first: ten times as long, and the convolution longer."""
        if n := self.around:
            x = torch.cat([x[:, :, -n:], x, x[:, :, :n]], dim=2)
        return super().forward(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)


def means(x: Tensor, radii: int, sectors: int) -> Tensor:
    """The means of blocks of so many radii and sectors. `mean` over two axes took 75 times as long."""
    return F.avg_pool2d(x.permute(0, 3, 1, 2), (radii, sectors)).permute(0, 2, 3, 1) if radii * sectors > 1 else x


def repeated(x: Tensor, radii: int, sectors: int) -> Tensor:
    """Every pixel so many times. With `repeat_interleave` a step took four times as long."""
    return F.interpolate(x.permute(0, 3, 1, 2), scale_factor=(radii, sectors)).permute(0, 2, 3, 1)
