"""Weights of models: names, parts, partial restore, checksums, averages, and the fit of the whitening layer."""

import dataclasses
import functools
import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sglpr_jax.models.config import WHITENING_POWER, ModelConfig
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import init

SEGMENTATION_LAYERS = ("segmentation_head", "narrow", "detail")
PIXEL_LAYERS = ("expand", "decoder")
"""Layers for the segmentation head, and for a place head with the tap `pixels` (`head.tap`)."""
SMALLEST_SPREAD = 1e-3
"""Minimum spread of a direction, as a fraction of the largest spread. Smaller spreads are replaced by it."""


def by_name(weights: Any) -> dict[str, Any]:
    """Flatten weights to a dictionary with names like `backbone/encoder_0/block_1/mlp_in/kernel`."""
    return flax.traverse_util.flatten_dict(weights, sep="/")


def as_tree(named: dict[str, Any]) -> Any:
    """Rebuild the nested dictionaries from the output of `by_name`."""
    return flax.traverse_util.unflatten_dict(named, sep="/")


@functools.cache
def weight_shapes(config: ModelConfig) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the shape and type of every weight of a configuration, without computing the weights."""
    return by_name(jax.eval_shape(lambda: init(jax.random.key(0), config=config)).weights)


def graft(given: Params, fresh: Params) -> Params:
    """Replace the weights of `fresh` by those of `given` that exist (partial restore), to continue a training.

    A kernel of `fresh` may have more input channels than that of `given`. The additional channels come last and start
    at 0, so a larger network initially computes the same as the smaller one. The segmentation head of `given` is
    dropped if `fresh` has none.

    Raises:
      ValueError: If `given` has another weight that `fresh` lacks, or one of another shape.
    """
    given = given if fresh.config.segments else for_places(given)
    weights = by_name(fresh.weights)
    for name, value in by_name(given.weights).items():
        wanted = weights[name].shape if name in weights else None
        if wanted is None or not _may_become(wanted, value.shape):
            expected = "no such weight" if wanted is None else wanted
            raise ValueError(f"cannot start from these weights: {name} has shape {value.shape}, expected {expected}")
        missing = np.subtract(wanted, value.shape)
        weights[name] = np.pad(np.asarray(value), [(0, more) for more in missing]) if missing.any() else value
    return dataclasses.replace(fresh, weights=as_tree(weights))


def _may_become(wanted: tuple[int, ...], found: tuple[int, ...]) -> bool:
    """Whether the shapes are equal, or of kernels where `wanted` has more input channels (last axis but one)."""
    same = wanted[:-2] + wanted[-1:] == found[:-2] + found[-1:]
    return wanted == found or (same and len(wanted) == len(found) in (2, 4) and wanted[-2] > found[-2])


def describing(params: Params) -> Any:
    """Return the layers that `describe` uses, without the segmentation head and layers that only serve it."""
    left_out = SEGMENTATION_LAYERS if params.config.head.tap == "pixels" else SEGMENTATION_LAYERS + PIXEL_LAYERS
    return {name: layer for name, layer in params.weights.items() if name not in left_out}


def for_places(params: Params) -> Params:
    """Return the part of a model that `describe` uses, for publication."""
    if not params.config.segments:
        return params
    return Params(describing(params), dataclasses.replace(params.config, categories=0))


def learning_segmentation_alone(params: Params) -> Params:
    """Return the same model with gradients only for the weights that `describe` does not use."""
    return dataclasses.replace(params, weights=params.weights | jax.lax.stop_gradient(describing(params)))


def weights_hash(params: Params) -> str:
    """Return the SHA-256 of names, shapes, types and values of the weights that `describe` uses.

    It identifies the weights that made a descriptor. Models that differ only in the segmentation head make the same
    descriptors and have the same hash.
    """
    return hash_of(by_name(describing(params)))


def hash_of(named: Mapping[str, Any]) -> str:
    """Return the SHA-256 of names, shapes, types and values of arrays, in the order of their names."""
    digest = hashlib.sha256()
    for name, leaf in sorted(named.items()):
        digest.update(f"{name} {leaf.shape} {leaf.dtype}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def average(models: Sequence[Params], *, shares: Sequence[float] | None = None) -> Params:
    """Average the weights of models with equal configurations, without their whitening layers.

    The average is useful only if one training started from the weights of another.

    Arguments:
      models: Models whose configurations are equal except for the whitening layer.
      shares: Contribution of each model, 0 or more and at least one above 0. By default all models contribute equally.

    Raises:
      ValueError: If the configurations differ, or if the shares are invalid.
    """
    shares = [1.0] * len(models) if shares is None else list(shares)
    if len(shares) != len(models) or min(shares, default=0) < 0 or sum(shares) == 0:
        raise ValueError(f"expected {len(models)} shares of 0 or more, not all 0, found {shares}")
    parts = [unwhitened(model) for model in models]
    for part in parts[1:]:
        a, b = (by_name(dataclasses.asdict(params.config)) for params in (parts[0], part))
        if name := min((name for name in a.keys() | b.keys() if a.get(name) != b.get(name)), default=None):
            found = f"{name.replace('/', '.')} {a.get(name)} and {b.get(name)}"
            raise ValueError(f"expected models with equal configurations, found {found}")

    factors = [share / sum(shares) for share in shares]

    def mean(*values: Any) -> Any:
        return sum(jnp.asarray(one, jnp.float32) * factor for one, factor in zip(values, factors, strict=True))

    return Params(jax.tree.map(mean, *(part.weights for part in parts)), parts[0].config)


def fit_whitening(descriptors: Float[np.ndarray, "n d"], *, power: float = WHITENING_POWER) -> Float[np.ndarray, "d d"]:
    """Fit the kernel of the whitening layer to descriptors of any places, without labels or poses.

    A principal component with spread s gets a spread proportional to s**(1 - power), both about the origin, where
    descriptors of length 1 are compared by their angles. Power 1 whitens fully.

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
    """Return `params`, which has no whitening layer, with one that is fitted to its descriptors.

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
