"""Which layers a backbone's configuration stands for; it does not say so itself, for it is read without JAX."""

from sglpr_jax.models.backbones.interface import Backbone
from sglpr_jax.models.backbones.rings import RingBackbone
from sglpr_jax.models.backbones.rings_config import RingConfig
from sglpr_jax.models.backbones.sglpr import SglprBackbone
from sglpr_jax.models.backbones.sglpr_config import SglprConfig
from sglpr_jax.models.backbones.swin import SwinBackbone
from sglpr_jax.models.backbones.swin_config import SwinConfig
from sglpr_jax.models.config import BackboneConfig


def build(config: BackboneConfig, *, circular: bool) -> Backbone:
    """The layers; in a `circular` image the first column is the last one's neighbour."""
    match config:
        case SwinConfig():
            return SwinBackbone(config, circular)
        case RingConfig():
            return RingBackbone(config)
        case SglprConfig():
            return SglprBackbone(config)
