"""State of a training run between steps."""

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
    """Number of finished steps, the weights, and the moments of Adam."""

    step: Any
    params: Params
    optimizer: Any


def new_state(config: TrainConfig, *, key: Array | None = None, params: Params | None = None) -> TrainState:
    """Return the state before the first step, with the given weights or with random weights from `key`.

    Without `key`, the seed of the configuration is used.
    """
    if params is None:
        params = init(jax.random.key(config.seed) if key is None else key, config=config.model)
    return TrainState(jnp.zeros((), jnp.int32), params, optimizer(config.optimizer).init(params.weights))
