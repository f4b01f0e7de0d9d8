"""Fit the place head's last layer, which lets directions of the descriptor count that hardly vary.

Descriptors spread along a few directions. Principal components divided by a power of their spread even that out; the
spread is about the origin, for descriptors of length 1 are compared by their angles there. The layer is fitted to
descriptors of any places, without labels or poses: of the training's, or of a sensor of one's own.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sglpr_jax.models.config import WHITENING_POWER, ModelConfig
from sglpr_jax.models.params import Params

SMALLEST_SPREAD = 1e-3
"""Of the largest one: directions that vary less count as if they varied so much."""


def fit_whitening(descriptors: Float[np.ndarray, "n d"], *, power: float = WHITENING_POWER) -> Float[np.ndarray, "d d"]:
    """The kernel whose result has spread s**(1 - power) along principal component s, both about the origin.

    Power 1 whitens fully. Raises ValueError for descriptors that do not differ. From fewer than d of them nothing is
    known of some directions.
    """
    d = np.asarray(descriptors, np.float64)
    if not np.ptp(d, axis=0).any():
        raise ValueError(f"expected descriptors of several places to whiten with, found {len(d)}, all equal")
    squares, components = np.linalg.eigh(d.T @ d / len(d))
    spread = np.sqrt(np.maximum(squares, squares.max() * SMALLEST_SPREAD**2))
    return (components / (spread / spread.max()) ** power).astype(np.float32)


def whitened(params: Params, descriptors: Float[np.ndarray, "n d"], *, power: float = WHITENING_POWER) -> Params:
    """`params` with a last layer fitted to descriptors that they gave without one (see `unwhitened`)."""
    if params.config.head.whiten:
        raise ValueError("expected weights without a whitening layer, found one")
    kernel = fit_whitening(descriptors, power=power)
    layer = {"kernel": jnp.asarray(kernel), "bias": jnp.zeros(len(kernel))}
    head = {**params.weights["place_head"], "whiten": layer}
    return Params({**params.weights, "place_head": head}, _with_layer(params.config, present=True))


def unwhitened(params: Params) -> Params:
    """`params` without that layer; themselves where they have none."""
    if not params.config.head.whiten:
        return params
    head = {name: value for name, value in params.weights["place_head"].items() if name != "whiten"}
    return Params({**params.weights, "place_head": head}, _with_layer(params.config, present=False))


def _with_layer(config: ModelConfig, *, present: bool) -> ModelConfig:
    return dataclasses.replace(config, head=dataclasses.replace(config.head, whiten=present))
