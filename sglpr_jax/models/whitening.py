"""Fit the place head's last layer, which lets directions of the descriptor count that hardly vary.

Descriptors spread along a few directions. Principal components divided by a power of their spread even that out. The
layer is fitted to descriptors of any places, without labels or poses: of the training's, or of a sensor of one's own.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.params import Params

SMALLEST_SPREAD = 1e-3
"""Of the largest one: directions that vary less count as if they varied so much."""


def fit_whitening(
    descriptors: Float[np.ndarray, "n d"], *, power: float = 0.5
) -> tuple[Float[np.ndarray, "d d"], Float[np.ndarray, "d"]]:
    """The kernel and bias whose result has spread s**(1 - power) along principal component s; power 1 whitens fully.

    Raises ValueError for descriptors that do not differ. From fewer than d of them nothing is known of some directions.
    """
    d = np.asarray(descriptors, np.float64)
    if not np.ptp(d, axis=0).any():
        raise ValueError(f"expected descriptors of several places to whiten with, found {len(d)}, all equal")
    mean = d.mean(0)
    variances, components = np.linalg.eigh(np.cov(d - mean, rowvar=False))
    spread = np.sqrt(np.maximum(variances, variances.max() * SMALLEST_SPREAD**2))
    kernel = components / (spread / spread.max()) ** power
    return kernel.astype(np.float32), (-mean @ kernel).astype(np.float32)


def whitened(params: Params, descriptors: Float[np.ndarray, "n d"], *, power: float = 0.5) -> Params:
    """`params` with a last layer fitted to descriptors that they gave without one (see `unwhitened`)."""
    if params.config.head.whiten:
        raise ValueError("expected weights without a whitening layer, found one")
    kernel, bias = fit_whitening(descriptors, power=power)
    head = {**params.weights["place_head"], "whiten": {"kernel": jnp.asarray(kernel), "bias": jnp.asarray(bias)}}
    return Params({**params.weights, "place_head": head}, _with_layer(params.config, present=True))


def unwhitened(params: Params) -> Params:
    """`params` without that layer; themselves where they have none."""
    if not params.config.head.whiten:
        return params
    head = {name: value for name, value in params.weights["place_head"].items() if name != "whiten"}
    return Params({**params.weights, "place_head": head}, _with_layer(params.config, present=False))


def _with_layer(config: ModelConfig, *, present: bool) -> ModelConfig:
    return dataclasses.replace(config, head=dataclasses.replace(config.head, whiten=present))
