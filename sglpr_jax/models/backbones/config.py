"""Union of the configurations of all backbones. `interface.py` defines the properties that they share."""

from sglpr_jax.models.backbones.circular_config import CircularConfig
from sglpr_jax.models.backbones.sglpr_config import SglprConfig
from sglpr_jax.models.backbones.swin_config import SwinConfig

BackboneConfig = SwinConfig | CircularConfig | SglprConfig
