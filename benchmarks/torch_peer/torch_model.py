"""The model, the losses and the training step as plain PyTorch modules, for timing and for checking against.

Modules have the names of our layers, so that our weights can be loaded.
"""

from collections.abc import Callable

import flax.traverse_util
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.torch_peer.torch_circular import CircularDecoder, CircularNet, Detail, Place
from benchmarks.torch_peer.torch_layers import InputImage, from_polar, to_polar
from benchmarks.torch_peer.torch_swin import SwinUnet
from sglpr_jax.losses import DICE_EPSILON
from sglpr_jax.models.backbone_config import SglprConfig
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.weights import Params
from sglpr_jax.training.config import LossConfig, TrainConfig

HEADS = ("place_head", "segmentation_head", "narrow", "detail")
"""Layers that are not the backbone's."""
INFERENCE = {"freezing": True}
"""Lets `torch.compile` take the weights for constants and reorder them beforehand."""


class Sglpr(nn.Module):
    """The Swin-Unet on the tokens of the circular CNN, and the circular CNN's decoder."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        own = config.backbone
        rows, columns = (edge // token for edge, token in zip(config.image_size, own.token, strict=True))
        self.backbone = nn.ModuleDict({"stem": CircularNet(config.channels, own.stem)})
        if own.depths:
            self.backbone["swin_unet"] = SwinUnet(own.stem.widths[-1], (rows, columns), own)
        if config.segments:
            self.decoder = CircularDecoder(own.width, config.channels, own.stem)

    def forward(self, image: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The features, and the maps that the decoder reads."""
        *finer, features = self.backbone["stem"](image)
        if "swin_unet" in self.backbone:
            features = self.backbone["swin_unet"](features)
        return features, finer

    def decode(self, features: Tensor, finer: list[Tensor]) -> Tensor:
        """Pixels of the size of the averaged image."""
        return self.decoder([*finer, features])


class SGLPR(nn.Module):
    """The backbone with the place head and, where the model has one, the segmentation head."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        _check(config)
        self.input_image = InputImage(config)
        self.view = to_polar(config.grid, *config.polar)
        self.backbone = Sglpr(config)
        self.place_head = Place(config.backbone.width, config.head)
        if config.segments:
            self.back = from_polar(config.grid, *(edge // config.backbone.stem.average for edge in config.image_size))
            self.narrow = nn.Linear(self.backbone.decoder.width, config.detail)
            self.detail = Detail(config.channels, config.detail)
            self.segmentation_head = nn.Linear(config.detail, config.classes, bias=False)

    def forward(self, counts: Tensor, *, segment: bool = False) -> tuple[Tensor, Tensor | None]:
        """Descriptors (b, d) and, if asked for, logits (b, h, w, classes) of images of counts (b, h, w)."""
        image = self.input_image(counts)
        features, finer = self.backbone(self.view(image))
        if not segment:
            return self.place_head(features), None
        pixels = self.narrow(self.backbone.decode(features, finer))
        return self.place_head(features), self.segmentation_head(self.detail(self.back(pixels), image))


def _check(config: ModelConfig) -> None:
    """Raises ValueError for a model of which PyTorch's has no counterpart."""
    head = config.head
    if not isinstance(config.backbone, SglprConfig):
        raise ValueError(f"the PyTorch model has the backbone sglpr, found {config.backbone.kind}")
    if not config.polar or not config.range_channel or head.tap != "tokens" or bool(head.channels) != bool(head.means):
        raise ValueError("the PyTorch model has a polar image, and a place head of tokens with circular blocks")
    if head.pooling != "netvlad" or head.whiten or config.counts != "log1p" or config.compute != "float32":
        raise ValueError("the PyTorch model takes log(1 + n) in float32, and has NetVLAD without whitening")


def from_params(params: Params) -> SGLPR:
    """The PyTorch model with our weights, the kernels of convolutions channels-last (`torch_layers`)."""
    model = SGLPR(params.config)
    flat = flax.traverse_util.flatten_dict(params.weights, sep=".")
    model.load_state_dict({_torch_name(name): torch.tensor(_torch_layout(name, w)) for name, w in flat.items()})
    return model.to(memory_format=torch.channels_last)


def _torch_name(name: str) -> str:
    """PyTorch's layers and ours have the same names, but there the backbone's are parts of it."""
    path, _, weight = name.rpartition(".")
    whole = "" if path.split(".")[0] in HEADS else "backbone."
    return f"{whole}{path}.{'weight' if weight in ('kernel', 'scale') else weight}"


def _torch_layout(name: str, weight: np.ndarray) -> np.ndarray:
    """Flax's (..., in, out) as PyTorch's (out, in, ...)."""
    return weight.transpose(-1, -2, *range(weight.ndim - 2)) if name.endswith("kernel") else weight


def joint_loss(descriptors: Tensor, logits: Tensor | None, maps: Tensor | None, config: LossConfig) -> Tensor:
    """Equation 8 of one tuple: anchor, one positive, negatives. Equation 5, with squared distances, without maps."""
    distances = (descriptors[:1] - descriptors[1:]).square().sum(-1)
    triplet = (config.margin + distances[0] - distances[1:]).relu().max()
    if maps is None:
        return triplet
    cross_entropy = F.cross_entropy(logits.flatten(0, -2), maps.flatten())
    probability, truth = logits.softmax(-1), F.one_hot(maps, logits.shape[-1]).to(logits.dtype)
    overlap = (probability * truth).sum((0, 1, 2))
    size = probability.square().sum((0, 1, 2)) + truth.square().sum((0, 1, 2))
    dice = (1 - (2 * overlap + DICE_EPSILON) / (size + DICE_EPSILON)).mean()
    return triplet + config.ce_weight * cross_entropy + config.dice_weight * dice


def describe_job(params: Params, images: np.ndarray, compiled: bool) -> Callable[[], np.ndarray]:
    """Describes images of counts."""
    model, batch = from_params(params).eval(), torch.tensor(images)
    described = torch.compile(model, dynamic=False, options=INFERENCE) if compiled else model

    def job() -> np.ndarray:
        with torch.inference_mode():
            return described(batch)[0].numpy()

    return job


def train_job(
    params: Params, images: np.ndarray, maps: np.ndarray | None, config: TrainConfig, compiled: bool
) -> Callable[[], np.ndarray]:
    """Makes one training step and returns its loss and the norm of its gradient; without maps by the triplet loss."""
    model, batch = from_params(params), torch.tensor(images)
    truth = None if maps is None else torch.tensor(maps, dtype=torch.int64)
    adam = torch.optim.Adam(model.parameters(), lr=config.optimizer.learning_rate, fused=True)

    def loss_of(batch: Tensor, truth: Tensor | None) -> Tensor:
        return joint_loss(*model(batch, segment=truth is not None), truth, config.loss)

    forward = torch.compile(loss_of, dynamic=False) if compiled else loss_of

    def job() -> np.ndarray:
        loss = forward(batch, truth)
        adam.zero_grad()
        loss.backward()
        norm = nn.utils.get_total_norm(parameter.grad for parameter in model.parameters())
        adam.step()
        return np.array([loss.item(), norm.item()])

    return job
