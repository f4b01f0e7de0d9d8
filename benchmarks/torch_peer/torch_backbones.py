"""The backbones as PyTorch modules, with the layers and names of ours: from the image to features, back to pixels."""

from torch import Tensor, nn

from benchmarks.torch_peer.torch_circular import CircularDecoder, CircularNet
from benchmarks.torch_peer.torch_swin import PatchExpand, SwinUnet, Windows
from sglpr_jax.models.config import CircularConfig, ModelConfig, SglprConfig


class Swin(nn.Module):
    """The Swin-Unet; its way back is a linear layer."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        swin = config.backbone
        if swin.stem:
            raise ValueError(f"the PyTorch model has no stem: expected stem (), found {swin.stem}")
        rows, columns = (edge // swin.patch for edge in config.image_size)
        windows = Windows(swin.window, circular=config.polar is not None)
        self.backbone = SwinUnet(config.channels, (rows, columns), swin, windows, patch=swin.patch)
        self.width, self.pixel_size = swin.embed_dim, config.image_size
        if decodes(config):
            self.expand = PatchExpand(swin.embed_dim, swin.patch, swin.embed_dim)

    def forward(self, image: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The features, and the maps that the way back looks at again."""
        return self.backbone(image), []

    def decode(self, features: Tensor, finer: list[Tensor]) -> Tensor:
        """`pixel_size` pixels of `width` channels."""
        return self.expand(features)


class Circular(nn.Module):
    """The circular CNN, and its decoder."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.rings = CircularNet(config.channels, config.backbone)
        self.pixel_size = averaged(config, config.backbone)
        if decodes(config):
            self.decoder = CircularDecoder(config.backbone.width, config.channels, config.backbone)
            self.width = self.decoder.width

    def forward(self, image: Tensor) -> tuple[Tensor, list[Tensor]]:
        """As `Swin.forward`."""
        *finer, features = self.rings(image)
        return features, finer

    def decode(self, features: Tensor, finer: list[Tensor]) -> Tensor:
        """As `Swin.decode`."""
        return self.decoder([*finer, features])


class Sglpr(nn.Module):
    """The Swin-Unet on the tokens of the circular CNN, and the circular CNN's decoder."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        own: SglprConfig = config.backbone
        rows, columns = (edge // token for edge, token in zip(config.image_size, own.token, strict=True))
        windows = Windows(own.window, own.mlp_ratio, circular=True, shift_each_way=True)
        swin_unet = SwinUnet(own.stem.width, (rows, columns), own, windows, patch=1)
        self.backbone = nn.ModuleDict({"stem": CircularNet(config.channels, own.stem), "swin_unet": swin_unet})
        self.pixel_size = averaged(config, own.stem)
        if decodes(config):
            self.decoder = CircularDecoder(own.width, config.channels, own.stem)
            self.width = self.decoder.width

    def forward(self, image: Tensor) -> tuple[Tensor, list[Tensor]]:
        """As `Swin.forward`."""
        *finer, last = self.backbone["stem"](image)
        return self.backbone["swin_unet"](last), finer

    def decode(self, features: Tensor, finer: list[Tensor]) -> Tensor:
        """As `Swin.decode`."""
        return self.decoder([*finer, features])


BACKBONES = {"swin": Swin, "circular": Circular, "sglpr": Sglpr}
"""By the kind that their configuration names."""


def decodes(config: ModelConfig) -> bool:
    """Whether anything reads pixels; else there are no weights of the way back."""
    return config.segments or config.head.tap == "pixels"


def averaged(config: ModelConfig, rings: CircularConfig) -> tuple[int, int]:
    """Rows and columns of the averaged image."""
    rows, columns = (edge // rings.average for edge in config.image_size)
    return rows, columns
