"""The optimiser: Adam, its learning rate warmed up and then decayed."""

import dataclasses

import optax

from sglpr_jax.fields import Count, CountOrNone, NotNegative, Positive, check_fields


@dataclasses.dataclass(frozen=True)
class OptimizerConfig:
    """Adam with an exponential decay of the learning rate."""

    learning_rate: NotNegative = 1e-5
    warmup_steps: CountOrNone = 0
    decay_rate: Positive = 0.99
    decay_steps: Count = 1000
    """Steps in which the learning rate falls by `decay_rate`."""
    staircase: bool = False
    clip_norm: Positive | None = None
    weight_decay: NotNegative = 0.0

    def __post_init__(self):
        check_fields(self)


def optimizer(config: OptimizerConfig) -> optax.GradientTransformation:
    """Return Adam, its learning rate warmed up linearly and then decayed exponentially (section 5.1.2)."""
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
