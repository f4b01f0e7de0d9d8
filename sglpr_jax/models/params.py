"""Weights together with the model they belong to."""

from typing import Any

import flax.struct

from sglpr_jax.models.config import ModelConfig


@flax.struct.dataclass
class Params:
    """What every call takes: a pytree of weights whose static part is `config`."""

    weights: Any
    """Arrays in nested dictionaries; a layer's name in the model leads to its weights."""
    config: ModelConfig = flax.struct.field(pytree_node=False)
