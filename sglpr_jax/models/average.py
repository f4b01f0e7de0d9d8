"""Average of the weights of related trainings, which is often better than each of them."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from sglpr_jax.models.params import Params
from sglpr_jax.models.weights import by_name
from sglpr_jax.models.whitening import unwhitened


def average(models: Sequence[Params], *, shares: Sequence[float] | None = None) -> Params:
    """Average the weights of models with equal configurations.

    The average is useful only if one training started from the weights of another. In independent trainings the same
    channel has different meanings. Whitening layers are removed, because each was fitted to the descriptors of its own
    model. Fit a new one to the average.

    Arguments:
      models: Models whose configurations are equal except for the whitening layer.
      shares: Contribution of each model, 0 or more and at least one above 0. By default all models contribute equally.

    Raises:
      ValueError: If the configurations differ, or if the shares are invalid.

    Example:
      average([load("runs/before"), load("runs/after")], shares=[0.3, 0.7])
    """
    shares = [1.0] * len(models) if shares is None else list(shares)
    if len(shares) != len(models) or min(shares, default=0) < 0 or sum(shares) == 0:
        raise ValueError(f"expected {len(models)} shares of 0 or more, not all 0, found {shares}")
    parts = [unwhitened(model) for model in models]
    for part in parts[1:]:
        _require_same_model(parts[0], part)
    weighted = [_times(part.weights, share / sum(shares)) for share, part in zip(shares, parts, strict=True)]
    return Params(jax.tree.map(lambda *values: sum(values), *weighted), parts[0].config)


def _times(weights: Any, factor: float) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32) * factor, weights)


def _require_same_model(one: Params, other: Params) -> None:
    a, b = (by_name(dataclasses.asdict(params.config)) for params in (one, other))
    different = sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name))
    if different:
        name = different[0]
        found = f"{name.replace('/', '.')} {a.get(name)} and {b.get(name)}"
        raise ValueError(f"expected models with equal configurations, found {found}")
