"""The paper's backbone: a Swin-Unet (section 4.1.1), if asked for with convolutions in front."""

import dataclasses
from typing import Literal

from jaxtyping import Array, Float

from sglpr_jax.fields import Depths, Share, Size, Sizes, check_fields
from sglpr_jax.models.backbones.interface import Seen
from sglpr_jax.models.backbones.stem import Stem, StemDecoder
from sglpr_jax.models.backbones.swin_layers import FinalPatchExpand, check_stages
from sglpr_jax.models.backbones.swin_unet import SwinUnet


@dataclasses.dataclass(frozen=True)
class SwinConfig:
    """A Swin-Unet. The default is the paper's; stage i has `embed_dim` * 2**i channels."""

    kind: Literal["swin"] = "swin"
    patch: Size = 4
    """Edge of a token's patch, in pixels of the image."""
    stem: Sizes = ()
    """Widths of convolutions before the patch embedding, the second and later ones at half the resolution of the one
    before; the segmentation head sees each of them again. (): none, as in the paper."""
    embed_dim: Size = 96
    depths: Depths = (2, 2, 2, 2)
    """Blocks of each stage."""
    heads: Sizes = (3, 6, 12, 24)
    """Attention heads of each stage."""
    window: Size = 7
    """Edge of an attention window, in tokens."""
    drop_path: Share = 0.2
    """Stochastic depth: the share of samples for which training leaves the last block out; 0 for the first block."""

    def __post_init__(self):
        check_fields(self)
        check_stages(self.embed_dim, self.depths, self.heads)
        if self.patch % self._stem_pixel:
            raise ValueError(
                f"expected a patch made of the stem's pixels of {self._stem_pixel} cells ({len(self.stem)} widths), "
                f"found patch {self.patch}"
            )

    @property
    def token(self) -> tuple[int, int]:
        """Rows and columns of the image that one token stands for."""
        return self.patch, self.patch

    @property
    def width(self) -> int:
        """Channels of the tokens."""
        return self.embed_dim

    @property
    def multiple(self) -> tuple[int, int]:
        """The image's rows and columns must be a multiple of this: one token of the coarsest stage."""
        return (self.patch * 2 ** (len(self.depths) - 1),) * 2

    @property
    def needs_polar(self) -> bool:
        """Windows fit any image."""
        return False

    @property
    def pictures(self) -> dict[str, str]:
        """Which maps are drawn; a normalised one would be as strong everywhere."""
        last = len(self.depths) - 1
        return {"encoder, first": "enc0_out", "encoder, last": f"enc{last}_out", "decoder": f"dec{last}_out"}

    @property
    def stem_patch(self) -> int:
        """Edge of a token's patch in pixels of the map that it is cut from: the image, or the stem's last map."""
        return self.patch // self._stem_pixel

    @property
    def _stem_pixel(self) -> int:
        return 2 ** max(len(self.stem) - 1, 0)

    def build(self, *, circular: bool) -> "SwinBackbone":
        """The layers."""
        return SwinBackbone(self, circular)


@dataclasses.dataclass(frozen=True)
class SwinBackbone:
    """The Swin-Unet, with or without a stem; layers `stem`, `backbone`, and `expand` or `decoder`."""

    config: SwinConfig
    circular: bool

    def __call__(self, image: Float[Array, "b p q c"], *, train: bool) -> Seen:
        """The tokens, and the maps of the stem."""
        config = self.config
        finer = Stem(config.stem, self.circular, name="stem")(image) if config.stem else []
        swin_unet = SwinUnet(
            embed_dim=config.embed_dim,
            depths=config.depths,
            heads=config.heads,
            window=config.window,
            patch=config.stem_patch,
            drop_path=config.drop_path,
            circular=self.circular,
            name="backbone",
        )
        tokens, named = swin_unet(finer[-1] if finer else image, train=train)
        return Seen(tokens, finer, named)

    def decode(self, seen: Seen) -> Float[Array, "b _ _ _"]:
        """A pixel for each pixel of the image: by a linear layer, or past the maps of the stem."""
        if self.config.stem:
            return StemDecoder(self.config.stem_patch, self.circular, name="decoder")(seen.features, seen.finer)
        return FinalPatchExpand(self.config.patch, name="expand")(seen.features)
