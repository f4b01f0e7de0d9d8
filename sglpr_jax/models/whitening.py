"""Fit of the place head's last layer, which amplifies directions in which descriptors hardly vary.

Descriptors vary mostly along a few directions. The layer divides principal components by a power of their spread. The
spread is measured about the origin, because descriptors of length 1 are compared by their angles there. The layer is
fitted to descriptors of any places, without labels or poses: those of the training, or of your own sensor.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sglpr_jax.models.config import WHITENING_POWER, ModelConfig
from sglpr_jax.models.params import Params

SMALLEST_SPREAD = 1e-3
"""Minimum spread of a direction, as a fraction of the largest spread. Smaller spreads are replaced by it."""


def fit_whitening(descriptors: Float[np.ndarray, "n d"], *, power: float = WHITENING_POWER) -> Float[np.ndarray, "d d"]:
    """Fit the kernel of the whitening layer.

    A principal component with spread s gets a spread proportional to s**(1 - power), both about the origin. Power 1
    whitens fully. Fewer than d descriptors leave some directions undetermined.

    Raises:
      ValueError: If all descriptors are equal.
    """
    d = np.asarray(descriptors, np.float64)
    if not np.ptp(d, axis=0).any():
        raise ValueError(f"expected descriptors of several places for whitening, found {len(d)} equal descriptors")
    squares, components = np.linalg.eigh(d.T @ d / len(d))
    spread = np.sqrt(np.maximum(squares, squares.max() * SMALLEST_SPREAD**2))
    return (components / (spread / spread.max()) ** power).astype(np.float32)


def whitened(params: Params, descriptors: Float[np.ndarray, "n d"], *, power: float = WHITENING_POWER) -> Params:
    """Return `params` with a whitening layer that is fitted to descriptors.

    The descriptors must come from `params` without a whitening layer (see `unwhitened`).

    Raises:
      ValueError: If `params` already has a whitening layer.
    """
    if params.config.head.whiten:
        raise ValueError("expected weights without a whitening layer, found one")
    kernel = fit_whitening(descriptors, power=power)
    layer = {"kernel": jnp.asarray(kernel), "bias": jnp.zeros(len(kernel))}
    head = {**params.weights["place_head"], "whiten": layer}
    return Params({**params.weights, "place_head": head}, _with_layer(params.config, present=True))


def unwhitened(params: Params) -> Params:
    """Return `params` without the whitening layer, or unchanged if there is no whitening layer."""
    if not params.config.head.whiten:
        return params
    head = {name: value for name, value in params.weights["place_head"].items() if name != "whiten"}
    return Params({**params.weights, "place_head": head}, _with_layer(params.config, present=False))


def _with_layer(config: ModelConfig, *, present: bool) -> ModelConfig:
    return dataclasses.replace(config, head=dataclasses.replace(config.head, whiten=present))
