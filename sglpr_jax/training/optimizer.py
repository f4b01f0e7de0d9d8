"""The optimiser: Adam with warm-up and decay of the learning rate."""

import optax

from sglpr_jax.training.config import OptimizerConfig


def optimizer(config: OptimizerConfig) -> optax.GradientTransformation:
    """Return Adam with linear warm-up and exponential decay of the learning rate (section 5.1.2)."""
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
