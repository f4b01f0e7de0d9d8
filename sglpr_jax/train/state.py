"""What training carries from step to step, and the optimiser that moves it."""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from sglpr_jax.models.sglpr import Params, init
from sglpr_jax.train.config import OptimizerConfig, TrainConfig


@flax.struct.dataclass
class TrainState:
    """The step about to be made, the weights, and Adam's moments."""

    step: Any
    params: Params
    optimizer: Any


def optimizer(config: OptimizerConfig) -> optax.GradientTransformation:
    """Adam, its learning rate warmed up linearly and then decayed exponentially (section 5.1.2)."""
    schedule = optax.warmup_exponential_decay_schedule(
        init_value=config.learning_rate if config.warmup_steps == 0 else 0.0,
        peak_value=config.learning_rate,
        warmup_steps=config.warmup_steps,
        transition_steps=config.decay_steps,
        decay_rate=config.decay_rate,
        staircase=config.staircase,
    )
    clip = optax.identity() if config.clip_norm is None else optax.clip_by_global_norm(config.clip_norm)
    return optax.chain(clip, optax.adamw(schedule, weight_decay=config.weight_decay))


def new_state(config: TrainConfig, *, key: Array | None = None, params: Params | None = None) -> TrainState:
    """The state before the first step: fresh weights from `key` (default: the configured seed), or given ones."""
    if params is None:
        params = init(jax.random.key(config.seed) if key is None else key, config=config.model)
    return TrainState(jnp.zeros((), jnp.int32), params, optimizer(config.optimizer).init(params.weights))
