"""Parameters of a model: names, parts, partial restore, checksums, averages, and the fit of the whitening layer."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import flax.struct
import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.tensors import hash_of
from sglpr_jax.models.config import WHITENING_POWER, ModelConfig

SEGMENTATION_LAYERS = ("segmentation_head", "narrow", "detail")
PIXEL_LAYERS = ("expand", "decoder")
"""Layers for the segmentation head, and for a place head with `head.tap="pixels"`."""
SMALLEST_SPREAD = 1e-3
"""Minimum spread of a direction, as a fraction of the largest spread. Smaller spreads are replaced by it."""


@flax.struct.dataclass
class Params:
    """Parameters of a model: a pytree of weights whose static part is `config`."""

    weights: Any
    """Nested dictionaries of arrays, with the names of the model's layers as keys."""
    config: ModelConfig = flax.struct.field(pytree_node=False)


def by_name(weights: Any) -> dict[str, Any]:
    """Flatten weights to a dictionary with names like `backbone/encoder_0/block_1/mlp_in/kernel`."""
    return flax.traverse_util.flatten_dict(weights, sep="/")


def as_tree(named: dict[str, Any]) -> Any:
    """Rebuild the nested dictionaries from the output of `by_name`."""
    return flax.traverse_util.unflatten_dict(named, sep="/")


def graft(source: Params, target: Params) -> Params:
    """Return `target` with the weights that `source` has (partial restore), to continue a training.

    A kernel of `target` may have more input channels. They come after those of `source` and start at 0, so the larger
    network initially computes the same. If `target` has no segmentation head, that of `source` is dropped.

    Raises ValueError if `source` has a weight that `target` lacks, or that differs in more than the input channels.
    """
    source = source if target.config.segments else for_places(source)
    weights = by_name(target.weights)
    for name, value in by_name(source.weights).items():
        expected = weights[name].shape if name in weights else "no such weight"
        if value.shape != expected:
            is_kernel = name.endswith("/kernel") and name in weights and value.ndim == len(expected)
            added = np.subtract(expected, value.shape) if is_kernel else np.zeros(2, np.int64)
            added_inputs = added[-2]  # inputs are the last axis but one of a kernel
            if added_inputs <= 0 or np.count_nonzero(added) > 1:
                found = f"{name} has shape {value.shape}"
                raise ValueError(f"cannot start from these weights: {found}, expected {expected}")
            value = np.pad(np.asarray(value), [(0, int(length)) for length in added])
        weights[name] = value
    return dataclasses.replace(target, weights=as_tree(weights))


def adopt(source: Params, target: Params) -> Params:
    """Return `target` with the weights of `source` that have the same name and shape."""
    weights, theirs = by_name(target.weights), by_name(source.weights)
    same = {name: theirs[name] for name, own in weights.items() if name in theirs and theirs[name].shape == own.shape}
    return dataclasses.replace(target, weights=as_tree(weights | same))


def descriptor_layers(params: Params) -> Any:
    """Return the weights of the layers that `describe` uses, without those that only serve the segmentation head."""
    unused = SEGMENTATION_LAYERS if params.config.head.tap == "pixels" else SEGMENTATION_LAYERS + PIXEL_LAYERS
    return {name: layer for name, layer in params.weights.items() if name not in unused}


def for_places(params: Params) -> Params:
    """Return a model with only the layers that `describe` uses, for publication. It has no segmentation head."""
    if not params.config.segments:
        return params
    return Params(descriptor_layers(params), dataclasses.replace(params.config, categories=0))


def freeze_descriptor_layers(params: Params) -> Params:
    """Return the same model, in which the weights that `describe` uses have no gradients."""
    return dataclasses.replace(params, weights=params.weights | jax.lax.stop_gradient(descriptor_layers(params)))


def weights_hash(params: Params) -> str:
    """Return the SHA-256 that all models with comparable descriptors share: that of the teacher, if there is one."""
    return params.config.descriptors_of or own_hash(params)


def own_hash(params: Params) -> str:
    """Return the SHA-256 of the weights that `describe` uses."""
    return hash_of(by_name(descriptor_layers(params)))


def different_fields(a: ModelConfig, b: ModelConfig) -> dict[str, tuple[Any, Any]]:
    """Return the values of the fields that differ between two configurations, by dotted name like `head.clusters`."""
    a_values, b_values = (flax.traverse_util.flatten_dict(dataclasses.asdict(config), sep=".") for config in (a, b))
    names = sorted(a_values.keys() | b_values.keys())
    values = {name: (a_values.get(name), b_values.get(name)) for name in names}
    return {name: (a_value, b_value) for name, (a_value, b_value) in values.items() if a_value != b_value}


def average(models: Sequence[Params], *, shares: Sequence[float] | None = None) -> Params:
    """Return the weighted mean of models whose trainings started from each other, without whitening layers.

    Arguments:
      models: Models whose configurations are equal except for the whitening layer.
      shares: Weight of each model in the mean: 0 or more, not all 0. By default all models have equal weight.

    Raises:
      ValueError: If the configurations differ, or if the shares are invalid.
    """
    shares = [1.0] * len(models) if shares is None else list(shares)
    if len(shares) != len(models) or min(shares, default=0) < 0 or sum(shares) == 0:
        raise ValueError(f"expected {len(models)} shares of 0 or more, not all 0, found {shares}")
    models = [without_whitening(model) for model in models]
    for model in models[1:]:
        for name, (first, other) in different_fields(models[0].config, model.config).items():
            raise ValueError(f"expected models with equal configurations, found {name} {first} and {other}")
    factors = [share / sum(shares) for share in shares]

    def mean(*arrays: Any) -> Any:
        return sum(jnp.asarray(array, jnp.float32) * factor for array, factor in zip(arrays, factors, strict=True))

    config = dataclasses.replace(models[0].config, descriptors_of="")
    return Params(jax.tree.map(mean, *(model.weights for model in models)), config)


def fit_whitening(descriptors: Float[np.ndarray, "n d"], *, power: float = WHITENING_POWER) -> Float[np.ndarray, "d d"]:
    """Return the kernel of a whitening layer, fitted to descriptors of any places, without labels or poses.

    A principal component with spread s gets a spread proportional to s**(1 - power). Power 1 whitens fully. The spread
    is the root mean square, not the deviation from the mean, because whitened descriptors are scaled to length 1.

    Raises ValueError if all descriptors are equal.
    """
    x = np.asarray(descriptors, np.float64)
    if not np.ptp(x, axis=0).any():
        raise ValueError(f"expected descriptors of several places for whitening, found {len(x)} equal descriptors")
    mean_squares, components = np.linalg.eigh(x.T @ x / len(x))
    spread = np.sqrt(np.maximum(mean_squares, mean_squares.max() * SMALLEST_SPREAD**2))
    return (components / (spread / spread.max()) ** power).astype(np.float32)


def with_whitening(params: Params, descriptors: Float[np.ndarray, "n d"], *, power: float = WHITENING_POWER) -> Params:
    """Return `params` with a whitening layer fitted to its descriptors. Raises ValueError if it has one already."""
    if params.config.head.whiten:
        raise ValueError("expected weights without a whitening layer, found one")
    kernel = fit_whitening(descriptors, power=power)
    layer = {"kernel": jnp.asarray(kernel), "bias": jnp.zeros(len(kernel))}
    return _with_place_head(params, {**params.weights["place_head"], "whiten": layer}, whiten=True)


def without_whitening(params: Params) -> Params:
    """Return `params` without the whitening layer, if it has one."""
    if not params.config.head.whiten:
        return params
    place_head = {name: layer for name, layer in params.weights["place_head"].items() if name != "whiten"}
    return _with_place_head(params, place_head, whiten=False)


def _with_place_head(params: Params, place_head: dict[str, Any], *, whiten: bool) -> Params:
    """Return `params` with the weights `place_head` in the place head, and with `whiten` in its configuration.

    These weights make descriptors of their own.
    """
    head = dataclasses.replace(params.config.head, whiten=whiten)
    config = dataclasses.replace(params.config, head=head, descriptors_of="")
    return Params({**params.weights, "place_head": place_head}, config)
