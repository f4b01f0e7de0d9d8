"""Weights by name: shapes and parts of a model's weights, partial restore, and checksums."""

import dataclasses
import functools
import hashlib
from collections.abc import Mapping
from typing import Any

import flax.traverse_util
import jax
import numpy as np

from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import init

SEGMENTATION_LAYERS = ("segmentation_head", "narrow", "detail")
PIXEL_LAYERS = ("expand", "decoder")
"""Layers for the segmentation head, and for a place head with the tap `pixels` (`head.tap`)."""


def by_name(weights: Any) -> dict[str, Any]:
    """Flatten weights to a dictionary with names like `backbone/encoder_0/block_1/mlp_in/kernel`."""
    return flax.traverse_util.flatten_dict(weights, sep="/")


def as_tree(named: dict[str, Any]) -> Any:
    """Rebuild the nested dictionaries from the output of `by_name`."""
    return flax.traverse_util.unflatten_dict(named, sep="/")


@functools.cache
def weight_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """Return the shape of every weight of a configuration, without computing the weights."""
    fresh = jax.eval_shape(lambda: init(jax.random.key(0), config=config))
    return {name: leaf.shape for name, leaf in by_name(fresh.weights).items()}


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
