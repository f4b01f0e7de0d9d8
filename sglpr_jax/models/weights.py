"""Weights by name: which ones a model has, parts of them, and one number for all of them."""

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
"""For the segmentation head, and for a place head that is told to look there (`head.tap`)."""


def by_name(weights: Any) -> dict[str, Any]:
    """A flat dictionary of weights, named like `backbone/encoder_0/block_1/mlp_in/kernel`."""
    return flax.traverse_util.flatten_dict(weights, sep="/")


def as_tree(named: dict[str, Any]) -> Any:
    """The inverse of `by_name`."""
    return flax.traverse_util.unflatten_dict(named, sep="/")


@functools.cache
def weight_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """The shape of every weight that the configuration asks for; nothing is computed."""
    fresh = jax.eval_shape(lambda: init(jax.random.key(0), config=config))
    return {name: leaf.shape for name, leaf in by_name(fresh.weights).items()}


def graft(given: Params, fresh: Params) -> Params:
    """`fresh` with the values of `given` wherever that has them: to train on from weights handed out.

    A kernel may see more channels in `fresh` than in `given`: it begins with 0 for those that come last. So a larger
    network begins by computing what the smaller one does. A segmentation head is left out where `fresh` has none.
    Raises ValueError where `given` has another weight that `fresh` has not, or one of another shape.
    """
    given = given if fresh.config.segments else for_places(given)
    all_of_them, values = by_name(fresh.weights), by_name(given.weights)
    for name, value in values.items():
        wanted = all_of_them[name].shape if name in all_of_them else None
        if wanted is None or not _may_become(wanted, value.shape):
            expected = "no such weight" if wanted is None else wanted
            raise ValueError(f"cannot begin with these weights: {name} has shape {value.shape}, expected {expected}")
    values = {name: _with_zeros(value, all_of_them[name].shape) for name, value in values.items()}
    return dataclasses.replace(fresh, weights=as_tree(all_of_them | values))


def _may_become(wanted: tuple[int, ...], found: tuple[int, ...]) -> bool:
    """Whether the shapes are equal, or kernels' that differ in how many channels they see: the last axis but one."""
    if wanted == found:
        return True
    same = wanted[:-2] + wanted[-1:] == found[:-2] + found[-1:]
    return same and len(wanted) == len(found) in (2, 4) and wanted[-2] > found[-2]


def _with_zeros(value: Any, shape: tuple[int, ...]) -> Any:
    missing = [(0, wanted - found) for wanted, found in zip(shape, value.shape, strict=True)]
    return np.pad(np.asarray(value), missing) if np.any(missing) else value


def describing(params: Params) -> Any:
    """The layers that `describe` computes with: no segmentation head and nothing that feeds it alone."""
    left_out = SEGMENTATION_LAYERS if params.config.head.tap == "pixels" else SEGMENTATION_LAYERS + PIXEL_LAYERS
    return {name: layer for name, layer in params.weights.items() if name not in left_out}


def for_places(params: Params) -> Params:
    """The part that `describe` computes with, to hand out."""
    if not params.config.segments:
        return params
    return Params(describing(params), dataclasses.replace(params.config, categories=0))


def learning_segmentation_alone(params: Params) -> Params:
    """The same model, of whose weights those alone have a gradient that `describe` does without."""
    return dataclasses.replace(params, weights=params.weights | jax.lax.stop_gradient(describing(params)))


def weights_hash(params: Params) -> str:
    """SHA-256 over names, shapes and values of what `describe` computes with: it says which weights made a descriptor.

    Weights that differ in the segmentation head alone, or have none, make the same descriptors and have the same hash.
    """
    return hash_of(by_name(describing(params)))


def hash_of(named: Mapping[str, Any]) -> str:
    """SHA-256 over names, shapes, types and values of arrays, in the order of their names."""
    digest = hashlib.sha256()
    for name, leaf in sorted(named.items()):
        digest.update(f"{name} {leaf.shape} {leaf.dtype}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()
