"""The model, the losses and the training step as plain PyTorch modules, for timing and for checking against.

Weights have the names of the published Swin-Unet (`sglpr_jax.models.torch_import.torch_name`), so that ours can be
loaded. Maps are (b, h, w, c) throughout.
"""

from collections.abc import Callable

import flax.traverse_util
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sglpr_jax.losses import DICE_EPSILON
from sglpr_jax.models.backbones.attention import BLOCKED, relative_position_index, shift_mask
from sglpr_jax.models.backbones.swin_config import SwinConfig
from sglpr_jax.models.backbones.swin_layers import MLP_RATIO
from sglpr_jax.models.config import HeadConfig, ModelConfig
from sglpr_jax.models.params import Params
from sglpr_jax.models.torch_import import torch_name
from sglpr_jax.training.config import LossConfig, TrainConfig


class WindowAttention(nn.Module):
    """Multi-head attention in each window, with relative position bias and the mask of shifted windows."""

    def __init__(self, channels: int, heads: int, window: int, mask: Tensor | None):
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)
        self.relative_position_bias_table = nn.Parameter(torch.zeros((2 * window - 1) ** 2, heads))
        self.register_buffer("index", torch.as_tensor(relative_position_index(window)), persistent=False)
        self.register_buffer("mask", mask, persistent=False)

    def forward(self, windows: Tensor) -> Tensor:
        n, t, c = windows.shape
        q, k, v = self.qkv(windows).reshape(n, t, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        scores = (q * (c // self.heads) ** -0.5) @ k.transpose(-2, -1)
        scores = scores + self.relative_position_bias_table[self.index].permute(2, 0, 1)
        if self.mask is not None:
            scores = (scores.reshape(-1, len(self.mask), self.heads, t, t) + self.mask[:, None]).reshape(scores.shape)
        return self.proj((scores.softmax(-1) @ v).transpose(1, 2).reshape(n, t, c))


class Mlp(nn.Module):
    """Two linear layers around an activation."""

    def __init__(self, channels: int, hidden: int, activation: Callable[[Tensor], Tensor]):
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(channels, hidden), nn.Linear(hidden, channels)
        self.activation = activation

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(self.activation(self.fc1(x)))


class Block(nn.Module):
    """A Swin block on maps of `size`."""

    def __init__(self, size: tuple[int, int], channels: int, heads: int, *, shifted: bool, config: SwinConfig):
        super().__init__()
        self.window = min(config.window, *size)
        self.shift = self.window // 2 if shifted and min(size) > self.window else 0
        blocked = torch.as_tensor(shift_mask(*size, self.window, self.shift)) if self.shift else None
        mask = None if blocked is None else torch.where(blocked, BLOCKED, 0.0)
        self.norm1, self.norm2 = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.attn = WindowAttention(channels, heads, self.window, mask)
        self.mlp = Mlp(channels, MLP_RATIO * channels, F.gelu)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self._attend(self.norm1(x))
        return x + self.mlp(self.norm2(x))

    def _attend(self, x: Tensor) -> Tensor:
        b, h, w, c = x.shape
        m, shift = self.window, self.shift
        x = x.roll((-shift, -shift), (1, 2)) if shift else x
        windows = x.reshape(b, h // m, m, w // m, m, c).transpose(2, 3).reshape(-1, m * m, c)
        x = self.attn(windows).reshape(b, h // m, w // m, m, m, c).transpose(2, 3).reshape(b, h, w, c)
        return x.roll((shift, shift), (1, 2)) if shift else x


class PatchEmbed(nn.Module):
    """One token per patch of the image (b, h, w, c)."""

    def __init__(self, inputs: int, channels: int, patch: int):
        super().__init__()
        self.proj = nn.Conv2d(inputs, channels, patch, patch)
        self.norm = nn.LayerNorm(channels)

    def forward(self, image: Tensor) -> Tensor:
        return self.norm(self.proj(image.permute(0, 3, 1, 2)).permute(0, 2, 3, 1))


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


class Stage(nn.Module):
    """The blocks of one level of the U."""

    def __init__(self, level: int, config: SwinConfig, image_size: tuple[int, int]):
        super().__init__()
        height, width = (size // (config.patch * 2**level) for size in image_size)
        channels, heads = config.embed_dim * 2**level, config.heads[level]
        self.blocks = nn.Sequential(
            *(
                Block((height, width), channels, heads, shifted=i % 2 == 1, config=config)
                for i in range(config.depths[level])
            )
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.blocks(x)


class Place(nn.Module):
    """The place head: CBAM, convolutions, NetVLAD."""

    def __init__(self, channels: int, config: HeadConfig):
        super().__init__()
        self.cbam = Cbam(channels, config.cbam_reduction)
        self.steps = len(config.channels)
        shapes = zip((channels, *config.channels), config.channels, config.kernels, config.strides, strict=False)
        for i, (inputs, outputs, kernel, stride) in enumerate(shapes):
            padding = 0 if kernel == stride else kernel // 2
            self.add_module(f"convolution_{i}", nn.Conv2d(inputs, outputs, kernel, stride, padding))
            self.add_module(f"norm_{i}", nn.LayerNorm(outputs))
        self.netvlad = NetVlad(config.channels[-1], config.clusters, config.descriptor_size)

    def forward(self, x: Tensor) -> Tensor:
        x = self.cbam(x)
        for i in range(self.steps):
            convolution, norm = self.get_submodule(f"convolution_{i}"), self.get_submodule(f"norm_{i}")
            x = norm(convolution(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)).relu()
        return F.normalize(self.netvlad(x.flatten(1, 2)), dim=-1)


class Cbam(nn.Module):
    """The channel gate, then the spatial gate."""

    def __init__(self, channels: int, reduction: int):
        super().__init__()
        self.channel = nn.ModuleDict({"mlp": Mlp(channels, max(1, channels // reduction), F.relu)})
        self.spatial = nn.ModuleDict({"convolution": nn.Conv2d(2, 1, 7, padding=3)})

    def forward(self, x: Tensor) -> Tensor:
        mlp = self.channel["mlp"]
        x = x * (mlp(x.mean((1, 2))) + mlp(x.amax((1, 2)))).sigmoid()[:, None, None]
        pooled = torch.stack([x.amax(-1), x.mean(-1)], dim=1)
        return x * self.spatial["convolution"](pooled).sigmoid().permute(0, 2, 3, 1)


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

    def __init__(self, inputs: int, channels: int, width: int):
        super().__init__()
        self.local0, self.local1 = nn.Conv2d(inputs, 16, 5, padding=2), nn.Conv2d(16, 16, 3, padding=1)
        self.mix = nn.Linear(channels + 16, width)

    def forward(self, features: Tensor, image: Tensor) -> Tensor:
        local = self.local1(self.local0(image.permute(0, 3, 1, 2)).relu()).relu().permute(0, 2, 3, 1)
        return F.gelu(self.mix(torch.cat([features, local], dim=-1)))


class SGLPR(nn.Module):
    """Swin-Unet with the place head and the segmentation head."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        swin = config.backbone
        if config.polar or not isinstance(swin, SwinConfig):
            raise ValueError("the PyTorch model is a Swin-Unet without polar resampling")
        self.tap, levels, channels = config.head.tap, len(swin.depths), swin.embed_dim
        self.patch_embed = PatchEmbed(config.channels, channels, swin.patch)
        self.layers = nn.ModuleList(Stage(level, swin, config.image_size) for level in range(levels))
        self.layers_up = nn.ModuleList([PatchExpand(channels * 2 ** (levels - 1), 2, channels * 2 ** (levels - 2))])
        self.concat_back_dim = nn.ModuleList([nn.Identity()])
        for level in range(levels - 1):
            self.layers[level].downsample = PatchMerging(channels * 2**level)
        for level in reversed(range(levels - 1)):
            width = channels * 2**level
            self.concat_back_dim.append(nn.Linear(2 * width, width))
            self.layers_up.append(Stage(level, swin, config.image_size))
            if level > 0:
                self.layers_up[-1].upsample = PatchExpand(width, 2, width // 2)
        self.norm, self.norm_up = nn.LayerNorm(channels * 2 ** (levels - 1)), nn.LayerNorm(channels)
        self.up = PatchExpand(channels, swin.patch, channels)
        self.detail = Detail(config.channels, config.detail, config.detail) if config.detail else None
        self.narrow = nn.Linear(channels, config.detail) if config.detail else None
        self.output = nn.Linear(config.detail or channels, config.classes, bias=False)
        self.place_head = Place(channels, config.head)

    def forward(self, image: Tensor, *, segment: bool = False) -> tuple[Tensor, Tensor | None]:
        """Descriptors (b, d) and, if asked for, logits (b, h, w, classes) of prepared images (b, h, w, c)."""
        tokens = self._backbone(image)
        pixels = self.up(tokens) if segment or self.tap == "pixels" else None
        descriptor = self.place_head(tokens if self.tap == "tokens" else pixels)
        if segment and self.detail is not None:
            pixels = self.detail(self.narrow(pixels), image)
        return descriptor, self.output(pixels) if segment else None

    def _backbone(self, image: Tensor) -> Tensor:
        x, skips = self.patch_embed(image), []
        for stage in self.layers:
            skips.append(x)
            x = stage(x)
            x = stage.downsample(x) if hasattr(stage, "downsample") else x
        x = self.layers_up[0](self.norm(x))
        for stage, fuse, skip in zip(self.layers_up[1:], self.concat_back_dim[1:], skips[-2::-1], strict=True):
            x = stage(fuse(torch.cat([x, skip], dim=-1)))
            x = stage.upsample(x) if hasattr(stage, "upsample") else x
        return self.norm_up(x)


def from_params(params: Params) -> SGLPR:
    """The PyTorch model with our weights."""
    model = SGLPR(params.config)
    flat = flax.traverse_util.flatten_dict(params.weights, sep="/")
    state = {torch_name(name): torch.tensor(_torch_layout(name, np.asarray(w))) for name, w in flat.items()}
    model.load_state_dict(state)
    return model


def _torch_layout(name: str, weight: np.ndarray) -> np.ndarray:
    """Flax's (..., in, out) as PyTorch's (out, in, ...)."""
    return weight.transpose(-1, -2, *range(weight.ndim - 2)) if name.endswith("kernel") else weight


def joint_loss(descriptors: Tensor, logits: Tensor, maps: Tensor, config: LossConfig) -> Tensor:
    """Equation 8 of one tuple: anchor, one positive, negatives. Equation 5 with squared distances."""
    distances = (descriptors[:1] - descriptors[1:]).square().sum(-1)
    triplet = (config.margin + distances[0] - distances[1:]).relu().max()
    cross_entropy = F.cross_entropy(logits.flatten(0, -2), maps.flatten())
    probability, truth = logits.softmax(-1), F.one_hot(maps, logits.shape[-1]).to(logits.dtype)
    overlap = (probability * truth).sum((0, 1, 2))
    size = probability.square().sum((0, 1, 2)) + truth.square().sum((0, 1, 2))
    dice = (1 - (2 * overlap + DICE_EPSILON) / (size + DICE_EPSILON)).mean()
    return triplet + config.ce_weight * cross_entropy + config.dice_weight * dice


def describe_job(params: Params, images: np.ndarray, chunk: int) -> Callable[[], np.ndarray]:
    """Describes the images, `chunk` at a time (0: all at once)."""
    model, batch = from_params(params).eval(), torch.tensor(images)

    def job() -> np.ndarray:
        with torch.inference_mode():
            return torch.cat([model(part)[0] for part in batch.split(chunk or len(batch))]).numpy()

    return job


def train_job(params: Params, images: np.ndarray, maps: np.ndarray, config: TrainConfig) -> Callable[[], np.ndarray]:
    """Makes one training step and returns its loss and the norm of its gradient."""
    model, batch, truth = from_params(params), torch.tensor(images), torch.tensor(maps, dtype=torch.int64)
    adam = torch.optim.Adam(model.parameters(), lr=config.optimizer.learning_rate)

    def job() -> np.ndarray:
        loss = joint_loss(*model(batch, segment=True), truth, config.loss)
        adam.zero_grad()
        loss.backward()
        norm = nn.utils.get_total_norm(parameter.grad for parameter in model.parameters())
        adam.step()
        return np.array([loss.item(), norm.item()])

    return job
