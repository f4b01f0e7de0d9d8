"""What training carries from step to step."""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array

from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import init
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.optimizer import optimizer


@flax.struct.dataclass
class TrainState:
    """The step about to be made, the weights, and Adam's moments."""

    step: Any
    params: Params
    optimizer: Any


def new_state(config: TrainConfig, *, key: Array | None = None, params: Params | None = None) -> TrainState:
    """The state before the first step: fresh weights from `key` (default: the configured seed), or given ones."""
    if params is None:
        params = init(jax.random.key(config.seed) if key is None else key, config=config.model)
    return TrainState(jnp.zeros((), jnp.int32), params, optimizer(config.optimizer).init(params.weights))
