"""Layers that the PyTorch modules share, the image as the network sees it, and its polar form.

Each layer has the form that was the fastest in PyTorch on a CPU. Maps (b, h, w, c) and kernels are channels-last.
Resamplings are weighted sums of four pixels: products with sparse matrices in eager PyTorch, gathers when compiled
(13 and 16 ms for 12 images of 32 channels; `F.grid_sample` takes 101 ms).
"""

import warnings
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sglpr_jax.grid import Grid
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.input_image import cell_distance, field_of_view


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


class Reading(NamedTuple):
    """Weighted sums of pixels, twice: as a matrix, and as the k pixels of each sum and their weights."""

    matrix: Tensor  # sparse, (n, pixels)
    pixel: Tensor  # (k, n)
    weight: Tensor  # (k, n, 1)


class Resampling(nn.Module):
    """Images (b, h, w, c) read at fixed places."""

    def __init__(self, row: np.ndarray, column: np.ndarray, size: tuple[int, int], *, where: np.ndarray | None = None):
        super().__init__()
        self.shape = row.shape
        place, pixel, weight = _bilinear(row, column, *size)
        kept = weight > 0 if where is None else (weight > 0) & where.reshape(-1)[place]
        place, pixel, weight = (x[kept] for x in (place, pixel, weight))
        self.there = _reading(place, pixel, weight, row.size, size[0] * size[1])
        self.back = _reading(pixel, place, weight, size[0] * size[1], row.size)

    def forward(self, x: Tensor) -> Tensor:
        return _Read.apply(x.flatten(1, 2), *self.there, *self.back).unflatten(1, self.shape)


class _Read(torch.autograd.Function):
    """The sums, and as their gradient the sums of those who read each pixel."""

    @staticmethod
    def forward(ctx, x: Tensor, *readings: Tensor) -> Tensor:
        ctx.save_for_backward(*readings[3:])
        return _sums(x, Reading(*readings[:3]))

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor | None, ...]:
        return _sums(gradient, Reading(*ctx.saved_tensors)), *(None,) * 6


def _sums(x: Tensor, reading: Reading) -> Tensor:
    if torch.compiler.is_compiling():
        return sum(x[:, pixel] * weight for pixel, weight in zip(reading.pixel, reading.weight, strict=True))
    return torch.stack([reading.matrix @ image for image in x])


def to_polar(grid: Grid, radii: int, sectors: int) -> Resampling:
    """From the grid to the polar image, rows by radius, columns counter-clockwise from x."""
    radius = (np.arange(radii) + 0.5) * (min(grid.height, grid.width) / 2 / radii)
    angle = (np.arange(sectors) + 0.5) * (2 * np.pi / sectors)
    row = (grid.height - 1) / 2 - np.outer(radius, np.sin(angle))
    column = (grid.width - 1) / 2 + np.outer(radius, np.cos(angle))
    size = (grid.height, grid.width)
    return Resampling(row.clip(0, grid.height - 1), column.clip(0, grid.width - 1), size)


def from_polar(grid: Grid, radii: int, sectors: int) -> Resampling:
    """From the polar image to the grid; zero beyond the circle."""
    down, right = np.mgrid[: grid.height, : grid.width]
    up, right = (grid.height - 1) / 2 - down, right - (grid.width - 1) / 2
    radius, reach = np.hypot(up, right), min(grid.height, grid.width) / 2
    row = (radius * (radii / reach) - 0.5).clip(0, radii - 1)
    column = np.arctan2(up, right) % (2 * np.pi) * (sectors / (2 * np.pi)) - 0.5
    return Resampling(row, column, (radii, sectors), where=radius < reach)


class InputImage(nn.Module):
    """Counts (b, h, w) as network input: log(1 + n) where the network sees, and the distance of every cell."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        distance = cell_distance(config.grid) / cell_distance(config.grid).max()
        self.register_buffer("seen", torch.tensor(field_of_view(config)[0]), persistent=False)
        self.register_buffer("distance", torch.tensor(distance)[None], persistent=False)

    def forward(self, counts: Tensor) -> Tensor:
        image = torch.where(self.seen, counts.log1p(), 0.0)
        return torch.stack([image, self.distance.expand_as(image)], dim=-1)


def _bilinear(row: np.ndarray, column: np.ndarray, height: int, width: int) -> tuple[np.ndarray, ...]:
    """For each of 4 n taps: the place (of n) that reads, the pixel that it reads, its weight; columns go around."""
    top, left = np.minimum(np.floor(row), height - 2).astype(int), np.floor(column).astype(int)
    down, right = row - top, column - left
    corners = [(y, x) for y in (0, 1) for x in (0, 1)]
    pixel = np.array([(top + y) * width + (left + x) % width for y, x in corners])
    weight = np.array([(down if y else 1 - down) * (right if x else 1 - right) for y, x in corners])
    return np.tile(np.arange(row.size), 4), pixel.reshape(-1), weight.reshape(-1).astype(np.float32)


def _reading(place: np.ndarray, pixel: np.ndarray, weight: np.ndarray, places: int, pixels: int) -> Reading:
    """Sums at `places` of `pixels`, in both forms; a place with fewer taps than others has some of weight 0."""
    order = np.argsort(place, kind="stable")
    place, pixel, weight = place[order], pixel[order], weight[order]
    taps = np.bincount(place, minlength=places)
    ends = np.cumsum(taps)
    slot = np.arange(len(place)) - (ends - taps)[place]
    of_slot, weights = np.zeros((taps.max(), places), int), np.zeros((taps.max(), places), np.float32)
    of_slot[slot, place], weights[slot, place] = pixel, weight
    starts = torch.tensor(np.concatenate([[0], ends]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that sparse matrices are in beta state
        matrix = torch.sparse_csr_tensor(starts, torch.tensor(pixel), torch.tensor(weight), (places, pixels))
    return Reading(matrix, torch.tensor(of_slot), torch.tensor(weights)[..., None])
