"""Weights together with the configuration of their model."""

from typing import Any

import flax.struct

from sglpr_jax.models.config import ModelConfig


@flax.struct.dataclass
class Params:
    """Parameters of a model: a pytree of weights whose static part is `config`."""

    weights: Any
    """Nested dictionaries of arrays, with the names of the model's layers as keys."""
    config: ModelConfig = flax.struct.field(pytree_node=False)
