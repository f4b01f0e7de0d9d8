"""The Swin-Unet as plain PyTorch modules, with the layers and names of ours."""

from collections import OrderedDict

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sglpr_jax.models.backbone_config import SglprConfig
from sglpr_jax.models.swin import BLOCKED, relative_position_index, shift_mask


class WindowAttention(nn.Module):
    """Multi-head attention in each window, with relative position bias and the mask of shifted windows."""

    def __init__(self, channels: int, heads: int, window: int, blocked: np.ndarray | None):
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(channels, 3 * channels)
        self.projection = nn.Linear(channels, channels)
        self.position_bias = nn.Parameter(torch.zeros((2 * window - 1) ** 2, heads))
        mask = None if blocked is None else torch.where(torch.tensor(blocked), BLOCKED, 0.0)
        self.register_buffer("index", torch.as_tensor(relative_position_index(window)), persistent=False)
        self.register_buffer("mask", mask, persistent=False)

    def forward(self, windows: Tensor) -> Tensor:
        n, t, c = windows.shape
        q, k, v = self.qkv(windows).reshape(n, t, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        scores = (q * (c // self.heads) ** -0.5) @ k.transpose(-2, -1)
        scores = scores + self.position_bias[self.index].permute(2, 0, 1)
        if self.mask is not None:
            scores = (scores.reshape(-1, len(self.mask), self.heads, t, t) + self.mask[:, None]).reshape(scores.shape)
        return self.projection((scores.softmax(-1) @ v).transpose(1, 2).reshape(n, t, c))


class Block(nn.Module):
    """A Swin block on maps of `size`."""

    def __init__(self, size: tuple[int, int], channels: int, heads: int, config: SglprConfig, *, shifted: bool):
        super().__init__()
        self.window = min(config.window, *size)
        down, right = (self.window // 2 if shifted and edge > self.window else 0 for edge in size)
        self.shift = down, right
        blocked = shift_mask(*size, self.window, (down, right), circular=True)
        hidden = config.mlp_ratio * channels
        self.attention_norm, self.mlp_norm = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.mlp_in, self.mlp_out = nn.Linear(channels, hidden), nn.Linear(hidden, channels)
        self.attention = WindowAttention(channels, heads, self.window, blocked if blocked.any() else None)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self._attend(self.attention_norm(x))
        return x + self.mlp_out(F.gelu(self.mlp_in(self.mlp_norm(x))))

    def _attend(self, x: Tensor) -> Tensor:
        b, h, w, c = x.shape
        m, (down, right) = self.window, self.shift
        x = x.roll((-down, -right), (1, 2)) if down or right else x
        windows = x.reshape(b, h // m, m, w // m, m, c).transpose(2, 3).reshape(-1, m * m, c)
        x = self.attention(windows).reshape(b, h // m, w // m, m, m, c).transpose(2, 3).reshape(b, h, w, c)
        return x.roll((down, right), (1, 2)) if down or right else x


class PatchEmbed(nn.Module):
    """One token per patch of the image (b, h, w, c)."""

    def __init__(self, inputs: int, channels: int, patch: int):
        super().__init__()
        self.projection = nn.Conv2d(inputs, channels, patch, patch)
        self.norm = nn.LayerNorm(channels)

    def forward(self, image: Tensor) -> Tensor:
        return self.norm(self.projection(image.permute(0, 3, 1, 2)).permute(0, 2, 3, 1))


class PatchMerging(nn.Module):
    """2 x 2 tokens become one of twice the channels."""

    def __init__(self, channels: int):
        super().__init__()
        self.norm = nn.LayerNorm(4 * channels)
        self.reduction = nn.Linear(4 * channels, 2 * channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        b, h, w, c = x.shape
        quads = x.reshape(b, h // 2, 2, w // 2, 2, c).permute(0, 1, 3, 4, 2, 5).reshape(b, h // 2, w // 2, 4 * c)
        return self.reduction(self.norm(quads))


class PatchExpand(nn.Module):
    """One token becomes factor x factor tokens of `output` channels."""

    def __init__(self, channels: int, factor: int, output: int):
        super().__init__()
        self.factor = factor
        self.expand = nn.Linear(channels, factor**2 * output, bias=False)
        self.norm = nn.LayerNorm(output)

    def forward(self, x: Tensor) -> Tensor:
        b, h, w, _ = x.shape
        f = self.factor
        tiles = self.expand(x).reshape(b, h, w, f, f, -1).transpose(2, 3)
        return self.norm(tiles.reshape(b, h * f, w * f, -1))


class SwinUnet(nn.ModuleDict):
    """Image to tokens, `size` of them; the encoder's stages, then the decoder's."""

    def __init__(self, inputs: int, size: tuple[int, int], config: SglprConfig):
        super().__init__()
        widths = [config.embed_dim * 2**level for level in range(len(config.depths))]
        self.coarsest = coarsest = len(widths) - 1
        self["patch_embed"] = PatchEmbed(inputs, widths[0], 1)
        self["norm"], self["norm_up"] = nn.LayerNorm(widths[-1]), nn.LayerNorm(widths[0])
        for level, width in enumerate(widths):
            mirrored = coarsest - level
            self[f"encoder_{level}"] = _stage(level, size, config)
            if mirrored:
                self[f"encoder_{level}_merge"] = PatchMerging(width)
                self[f"decoder_{mirrored}_fuse"] = nn.Linear(2 * width, width)
                self[f"decoder_{mirrored}"] = _stage(level, size, config)
            if level:
                self[f"decoder_{mirrored}_expand"] = PatchExpand(width, 2, width // 2)

    def forward(self, image: Tensor) -> Tensor:
        x, skips = self["patch_embed"](image), []
        for level in range(self.coarsest):
            skips.append(x)
            x = self[f"encoder_{level}_merge"](self[f"encoder_{level}"](x))
        x = self["norm"](self[f"encoder_{self.coarsest}"](x))
        for i in range(1, self.coarsest + 1):
            x = torch.cat([self[f"decoder_{i - 1}_expand"](x), skips[-i]], dim=-1)
            x = self[f"decoder_{i}"](self[f"decoder_{i}_fuse"](x))
        return self["norm_up"](x)


def _stage(level: int, size: tuple[int, int], config: SglprConfig) -> nn.Sequential:
    """The blocks of one level of the U."""
    height, width = (edge // 2**level for edge in size)
    channels, heads = config.embed_dim * 2**level, config.heads[level]
    blocks = (Block((height, width), channels, heads, config, shifted=i % 2 == 1) for i in range(config.depths[level]))
    return nn.Sequential(OrderedDict((f"block_{i}", block) for i, block in enumerate(blocks)))
