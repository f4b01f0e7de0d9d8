"""The paper's backbone: a Swin-Unet (section 4.1.1), optionally with convolutions in front."""

import dataclasses

from jaxtyping import Array, Float

from sglpr_jax.models.backbones.interface import Seen
from sglpr_jax.models.backbones.stem import Stem, StemDecoder
from sglpr_jax.models.backbones.swin_config import SwinConfig
from sglpr_jax.models.backbones.swin_layers import FinalPatchExpand
from sglpr_jax.models.backbones.swin_unet import SwinUnet


@dataclasses.dataclass(frozen=True)
class SwinBackbone:
    """Swin-Unet with or without a stem: layers `stem`, `backbone`, and `expand` or `decoder`."""

    config: SwinConfig
    circular: bool

    def __call__(self, image: Float[Array, "b p q c"], *, train: bool) -> Seen:
        """Computes the tokens and the maps of the stem."""
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
        """Computes a pixel for each pixel of the image, by a linear layer or, with a stem, by its decoder."""
        if self.config.stem:
            return StemDecoder(self.config.stem_patch, self.circular, name="decoder")(seen.features, seen.finer)
        return FinalPatchExpand(self.config.patch, name="expand")(seen.features)
