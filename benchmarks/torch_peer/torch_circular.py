"""The circular CNN, its decoder and the heads as plain PyTorch modules, with the layers and names of ours."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.torch_peer.torch_layers import Convolution, means, repeated
from sglpr_jax.models.backbone_config import CircularConfig
from sglpr_jax.models.config import HeadConfig


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


class Place(nn.Module):
    """The place head: CBAM, circular blocks, NetVLAD."""

    def __init__(self, channels: int, config: HeadConfig):
        super().__init__()
        self.cbam = Cbam(channels, config.cbam_reduction) if config.cbam else nn.Identity()
        self.means = config.means
        shapes = zip((channels, *config.channels), config.channels, config.strides, strict=False)
        for i, (inputs, outputs, stride) in enumerate(shapes):
            self.add_module(f"block_{i}", CircularBlock(inputs, outputs, stride))
        self.netvlad = NetVlad((channels, *config.channels)[-1], config.clusters, config.descriptor_size)

    def forward(self, x: Tensor) -> Tensor:
        x = self.cbam(x)
        for i, sectors in enumerate(self.means):
            x = means(self.get_submodule(f"block_{i}")(x), 1, sectors)
        return F.normalize(self.netvlad(x.flatten(1, 2)), dim=-1)


class Cbam(nn.Module):
    """The channel gate, then the spatial gate."""

    def __init__(self, channels: int, reduction: int):
        super().__init__()
        hidden = max(1, channels // reduction)
        layers = {"mlp_in": nn.Linear(channels, hidden), "mlp_out": nn.Linear(hidden, channels)}
        self.channel = nn.ModuleDict(layers)
        self.spatial = nn.ModuleDict({"convolution": Convolution(2, 1, 7, circular=True)})

    def forward(self, x: Tensor) -> Tensor:
        pooled = torch.stack([x.mean((1, 2)), x.amax((1, 2))])
        logits = self.channel["mlp_out"](self.channel["mlp_in"](pooled).relu()).sum(0)
        x = x * logits.sigmoid()[:, None, None]
        return x * self.spatial["convolution"](torch.stack([x.amax(-1), x.mean(-1)], dim=-1)).sigmoid()


class NetVlad(nn.Module):
    """Soft assignment to clusters, sums of residuals, a linear layer, context gating."""

    def __init__(self, channels: int, clusters: int, output: int):
        super().__init__()
        self.assignment = nn.Linear(channels, clusters)
        self.centres = nn.Parameter(torch.zeros(channels, clusters))
        self.hidden, self.gate = nn.Linear(channels * clusters, output), nn.Linear(output, output)

    def forward(self, features: Tensor) -> Tensor:
        assignment = self.assignment(features).softmax(-1)
        vlad = features.transpose(1, 2) @ assignment - assignment.sum(1)[:, None] * self.centres
        y = self.hidden(F.normalize(F.normalize(vlad, dim=1).flatten(1), dim=-1))
        return y * self.gate(y).sigmoid()


class Detail(nn.Module):
    """Two convolutions on the image, mixed with the features of every cell."""

    def __init__(self, inputs: int, width: int):
        super().__init__()
        self.local0 = Convolution(inputs, 16, 5, circular=False)
        self.local1 = Convolution(16, 16, 3, circular=False)
        self.mix = nn.Linear(width + 16, width)

    def forward(self, features: Tensor, image: Tensor) -> Tensor:
        local = self.local1(self.local0(image).relu()).relu()
        return F.gelu(self.mix(torch.cat([features, local], dim=-1)))
