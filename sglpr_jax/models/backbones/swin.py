"""The paper's backbone: a Swin-Unet (section 4.1.1)."""

import dataclasses

from jaxtyping import Array, Float

from sglpr_jax.models.backbones.interface import Seen
from sglpr_jax.models.backbones.swin_config import SwinConfig
from sglpr_jax.models.backbones.swin_layers import FinalPatchExpand
from sglpr_jax.models.backbones.swin_unet import SwinUnet


@dataclasses.dataclass(frozen=True)
class SwinBackbone:
    """Swin-Unet on patches of the image: layers `backbone` and `expand`."""

    config: SwinConfig
    circular: bool

    def __call__(self, image: Float[Array, "b p q c"], *, train: bool) -> Seen:
        """Computes the tokens."""
        config = self.config
        swin_unet = SwinUnet(
            embed_dim=config.embed_dim,
            depths=config.depths,
            heads=config.heads,
            window=config.window,
            patch=config.patch,
            drop_path=config.drop_path,
            circular=self.circular,
            name="backbone",
        )
        tokens, named = swin_unet(image, train=train)
        return Seen(tokens, [], named)

    def decode(self, seen: Seen) -> Float[Array, "b _ _ _"]:
        """Computes a pixel for each pixel of the image by a linear layer."""
        return FinalPatchExpand(self.config.patch, name="expand")(seen.features)
