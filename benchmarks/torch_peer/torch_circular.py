"""The circular CNN and its decoder as plain PyTorch modules, with the layers and names of ours."""

import torch
from torch import Tensor, nn

from benchmarks.torch_peer.torch_layers import Convolution, means, repeated
from sglpr_jax.models.config import CircularConfig


class CircularBlock(nn.Module):
    """Convolution around the sectors, layer norm, ReLU; added to its input where both have the same shape."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1):
        super().__init__()
        self.convolution = Convolution(inputs, outputs, 3, (stride, 1), circular=True)
        self.norm = nn.LayerNorm(outputs)

    def forward(self, x: Tensor) -> Tensor:
        y = self.norm(self.convolution(x)).relu()
        return x + y if x.shape == y.shape else y


class CircularNet(nn.ModuleDict):
    """From the polar image to the averaged image and the map of each block, with what joins it."""

    def __init__(self, inputs: int, config: CircularConfig):
        super().__init__()
        self.config, fine = config, inputs
        for i, channels in enumerate(config.fine):
            self[f"fine_{i}"] = CircularBlock(fine, channels, config.strides[i - 1] if i else config.average)
            fine = channels
        for i, (seen, width) in enumerate(zip(map_channels(inputs, config), config.widths, strict=False)):
            self[f"block_{i}"] = CircularBlock(seen, width, config.strides[i])

    def forward(self, polar: Tensor) -> list[Tensor]:
        config, fine = self.config, polar
        maps = [means(polar, config.average, config.average)]
        for i, sectors in enumerate(config.means):
            if i < len(config.fine):
                fine = self[f"fine_{i}"](fine)
                maps[-1] = torch.cat([maps[-1], means(fine, 1, fine.shape[2] // maps[-1].shape[2])], dim=-1)
            maps.append(means(self[f"block_{i}"](maps[-1]), 1, sectors))
        return maps


class CircularDecoder(nn.ModuleDict):
    """From features of so many channels back to the averaged image, past the maps that the circular CNN shrank."""

    def __init__(self, features: int, inputs: int, config: CircularConfig):
        super().__init__()
        shrink = zip(config.strides, config.means, strict=True)
        self.finer = [i for i, (stride, sectors) in enumerate(shrink) if stride * sectors > 1][::-1]
        for i, of_map in enumerate(self.finer):
            width, seen = config.widths[max(of_map - 1, 0)], map_channels(inputs, config)[of_map]
            self[f"narrow_{i}"], self[f"block_{i}"] = nn.Linear(features, width), CircularBlock(width + seen, width)
            features = width
        self.width = features

    def forward(self, maps: list[Tensor]) -> Tensor:
        x = maps[-1]
        for i, of_map in enumerate(self.finer):
            seen, x = maps[of_map], self[f"narrow_{i}"](x)
            x = repeated(x, seen.shape[1] // x.shape[1], seen.shape[2] // x.shape[2])
            x = self[f"block_{i}"](torch.cat([x, seen], dim=-1))
        return x


def map_channels(inputs: int, config: CircularConfig) -> list[int]:
    """Of the averaged image and the map of each block, with what joins it."""
    joining = (*config.fine, *(0,) * (len(config.widths) + 1 - len(config.fine)))
    return [own + more for own, more in zip((inputs, *config.widths), joining, strict=True)]
