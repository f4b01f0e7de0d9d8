"""Maps the configuration of a backbone to its layers. Configurations do not import layers, which require JAX."""

from sglpr_jax.models.backbones.circular import CircularBackbone
from sglpr_jax.models.backbones.circular_config import CircularConfig
from sglpr_jax.models.backbones.config import BackboneConfig
from sglpr_jax.models.backbones.interface import Backbone
from sglpr_jax.models.backbones.sglpr import SglprBackbone
from sglpr_jax.models.backbones.sglpr_config import SglprConfig
from sglpr_jax.models.backbones.swin import SwinBackbone
from sglpr_jax.models.backbones.swin_config import SwinConfig


def build(config: BackboneConfig, *, circular: bool) -> Backbone:
    """Return the layers of a backbone. With `circular=True` the first and last columns of the image are neighbours."""
    match config:
        case SwinConfig():
            return SwinBackbone(config, circular)
        case CircularConfig():
            return CircularBackbone(config)
        case SglprConfig():
            return SglprBackbone(config)
