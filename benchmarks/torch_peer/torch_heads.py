"""The heads as plain PyTorch modules, with the layers and names of ours."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.torch_peer.torch_circular import CircularBlock
from benchmarks.torch_peer.torch_layers import Convolution, means
from sglpr_jax.models.config import HeadConfig


class Place(nn.Module):
    """The place head: CBAM, convolutions, NetVLAD."""

    def __init__(self, channels: int, config: HeadConfig, *, circular: bool):
        super().__init__()
        self.cbam = Cbam(channels, config.cbam_reduction, circular=bool(config.means)) if config.cbam else nn.Identity()
        shapes = zip((channels, *config.channels), config.channels, config.kernels, config.strides, strict=False)
        self.steps, self.means = len(config.channels), config.means
        for i, (inputs, outputs, kernel, stride) in enumerate(shapes):
            if config.means:
                self.add_module(f"block_{i}", CircularBlock(inputs, outputs, stride))
                continue
            self.add_module(
                f"convolution_{i}", Convolution(inputs, outputs, kernel, (stride, stride), circular=circular)
            )
            self.add_module(f"norm_{i}", nn.LayerNorm(outputs))
        self.netvlad = NetVlad((channels, *config.channels)[-1], config.clusters, config.descriptor_size)

    def forward(self, x: Tensor) -> Tensor:
        x = self.cbam(x)
        for i in range(self.steps):
            x = self._convolve(x, i)
        return F.normalize(self.netvlad(x.flatten(1, 2)), dim=-1)

    def _convolve(self, x: Tensor, i: int) -> Tensor:
        if self.means:
            return means(self.get_submodule(f"block_{i}")(x), 1, self.means[i])
        return self.get_submodule(f"norm_{i}")(self.get_submodule(f"convolution_{i}")(x)).relu()


class Cbam(nn.Module):
    """The channel gate, then the spatial gate."""

    def __init__(self, channels: int, reduction: int, *, circular: bool):
        super().__init__()
        hidden = max(1, channels // reduction)
        layers = {"mlp_in": nn.Linear(channels, hidden), "mlp_out": nn.Linear(hidden, channels)}
        self.channel = nn.ModuleDict(layers)
        self.spatial = nn.ModuleDict({"convolution": Convolution(2, 1, 7, circular=circular)})

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
