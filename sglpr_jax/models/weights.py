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


def graft(source: Params, target: Params) -> Params:
    """Replace the weights of `target` by those of `source` that exist (partial restore), to continue a training.

    A kernel of `target` may have more input channels than that of `source`. The additional channels come last and start
    at 0, so a larger network initially computes the same as the smaller one. The segmentation head of `source` is
    dropped if `target` has none.

    Raises:
      ValueError: If `source` has another weight that `target` lacks, or one of another shape.
    """
    source = source if target.config.segments else for_places(source)
    weights = by_name(target.weights)
    for name, value in by_name(source.weights).items():
        expected = weights[name].shape if name in weights else "no such weight"
        if value.shape != expected:
            is_kernel = name in weights and value.ndim == len(expected) and value.ndim in (2, 4)
            added = np.subtract(expected, value.shape) if is_kernel else np.array([-1])
            if added.min() < 0 or added[-2] != added.sum():  # only the inputs (last axis but one) may be longer
                raise ValueError(
                    f"cannot start from these weights: {name} has shape {value.shape}, expected {expected}"
                )
            value = np.pad(np.asarray(value), [(0, length) for length in added])
        weights[name] = value
    return dataclasses.replace(target, weights=as_tree(weights))


def descriptor_layers(params: Params) -> Any:
    """Return the layers that `describe` uses, without the segmentation head and layers that only serve it."""
    unused = SEGMENTATION_LAYERS if params.config.head.tap == "pixels" else SEGMENTATION_LAYERS + PIXEL_LAYERS
    return {name: layer for name, layer in params.weights.items() if name not in unused}


def for_places(params: Params) -> Params:
    """Return the part of a model that `describe` uses, for publication."""
    if not params.config.segments:
        return params
    return Params(descriptor_layers(params), dataclasses.replace(params.config, categories=0))


def freeze_descriptor_layers(params: Params) -> Params:
    """Return the same model with gradients only for the weights that `describe` does not use."""
    return dataclasses.replace(params, weights=params.weights | jax.lax.stop_gradient(descriptor_layers(params)))


def weights_hash(params: Params) -> str:
    """Return the `hash_of` the weights that `describe` uses. It identifies the weights that made a descriptor."""
    return hash_of(by_name(descriptor_layers(params)))


def hash_of(named: Mapping[str, Any]) -> str:
    """Return the SHA-256 of names, shapes, types and values of arrays, in the order of their names."""
    digest = hashlib.sha256()
    for name, leaf in sorted(named.items()):
        digest.update(f"{name} {leaf.shape} {leaf.dtype}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def average(models: Sequence[Params], *, shares: Sequence[float] | None = None) -> Params:
    """Average the weights of models whose trainings started from each other, without their whitening layers.

    Arguments:
      models: Models whose configurations are equal except for the whitening layer.
      shares: Contribution of each model, 0 or more and at least one above 0. By default all models contribute equally.

    Raises:
      ValueError: If the configurations differ, or if the shares are invalid.
    """
    shares = [1.0] * len(models) if shares is None else list(shares)
    if len(shares) != len(models) or min(shares, default=0) < 0 or sum(shares) == 0:
        raise ValueError(f"expected {len(models)} shares of 0 or more, not all 0, found {shares}")
    models = [without_whitening(model) for model in models]
    first, *others = (by_name(dataclasses.asdict(model.config)) for model in models)
    for other in others:
        if names := sorted(name for name in first.keys() | other.keys() if first.get(name) != other.get(name)):
            found = f"{names[0].replace('/', '.')} {first.get(names[0])} and {other.get(names[0])}"
            raise ValueError(f"expected models with equal configurations, found {found}")
    factors = [share / sum(shares) for share in shares]

    def mean(*values: Any) -> Any:
        return sum(jnp.asarray(value, jnp.float32) * factor for value, factor in zip(values, factors, strict=True))

    return Params(jax.tree.map(mean, *(model.weights for model in models)), models[0].config)


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


def with_whitening(params: Params, descriptors: Float[np.ndarray, "n d"], *, power: float = WHITENING_POWER) -> Params:
    """Return `params` with a whitening layer fitted to its descriptors. Raises ValueError if it has one already."""
    if params.config.head.whiten:
        raise ValueError("expected weights without a whitening layer, found one")
    kernel = fit_whitening(descriptors, power=power)
    layer = {"kernel": jnp.asarray(kernel), "bias": jnp.zeros(len(kernel))}
    return _with_head(params, {**params.weights["place_head"], "whiten": layer}, whiten=True)


def without_whitening(params: Params) -> Params:
    """Return `params` without the whitening layer, if it has one."""
    if not params.config.head.whiten:
        return params
    head = {name: value for name, value in params.weights["place_head"].items() if name != "whiten"}
    return _with_head(params, head, whiten=False)


def _with_head(params: Params, place_head: dict[str, Any], *, whiten: bool) -> Params:
    head_config = dataclasses.replace(params.config.head, whiten=whiten)
    return Params({**params.weights, "place_head": place_head}, dataclasses.replace(params.config, head=head_config))
