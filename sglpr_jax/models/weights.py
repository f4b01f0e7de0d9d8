"""Weights of models: names, parts, partial restore, checksums, averages, and the fit of the whitening layer.

Descriptors vary mostly along a few directions. The whitening layer divides principal components by a power of their
spread. The spread is measured about the origin, because descriptors of length 1 are compared by their angles there. The
layer is fitted to descriptors of any places, without labels or poses.
"""

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
    all_of_them, values = by_name(fresh.weights), by_name(given.weights)
    for name, value in values.items():
        wanted = all_of_them[name].shape if name in all_of_them else None
        if wanted is None or not _may_become(wanted, value.shape):
            expected = "no such weight" if wanted is None else wanted
            raise ValueError(f"cannot start from these weights: {name} has shape {value.shape}, expected {expected}")
    values = {name: _with_zeros(value, all_of_them[name].shape) for name, value in values.items()}
    return dataclasses.replace(fresh, weights=as_tree(all_of_them | values))


def _may_become(wanted: tuple[int, ...], found: tuple[int, ...]) -> bool:
    """Whether the shapes are equal, or of kernels where `wanted` has more input channels (last axis but one)."""
    if wanted == found:
        return True
    same = wanted[:-2] + wanted[-1:] == found[:-2] + found[-1:]
    return same and len(wanted) == len(found) in (2, 4) and wanted[-2] > found[-2]


def _with_zeros(value: Any, shape: tuple[int, ...]) -> Any:
    missing = [(0, wanted - found) for wanted, found in zip(shape, value.shape, strict=True)]
    return np.pad(np.asarray(value), missing) if np.any(missing) else value


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
