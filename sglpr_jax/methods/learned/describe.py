"""Descriptors of prepared inputs by a learned method, in evaluation mode."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float32, Shaped

from sglpr_jax.methods.learned.method import LearnedMethod, Variables

BATCH = 16
"""Number of inputs that are described at a time."""


@functools.partial(jax.jit, static_argnames="method")
def apply_network(variables: Variables, inputs: Shaped[Any, "b ..."], *, method: LearnedMethod) -> Any:
    """Return the descriptors of inputs, in evaluation mode."""
    return method.network.apply(variables, inputs, train=False)


def describe_inputs(
    method: LearnedMethod, variables: Variables, inputs: Shaped[np.ndarray, "n ..."]
) -> Float32[np.ndarray, "n d"]:
    """Return the descriptors of all inputs, which may be a memory-mapped file.

    Raises ValueError if descriptors are invalid (`check_descriptors`).
    """
    found = []
    for start in range(0, len(inputs), BATCH):
        rows = np.asarray(inputs[start : start + BATCH])
        padded = np.concatenate([rows, np.repeat(rows[-1:], BATCH - len(rows), axis=0)])
        descriptors = np.asarray(apply_network(variables, padded, method=method))
        names = [f"input {start + row}" for row in range(len(rows))]
        found.append(check_descriptors(method.name, descriptors[: len(rows)], names))
    return np.concatenate(found)


def check_descriptors(method: str, descriptors: np.ndarray, names: Sequence[str]) -> Float32[np.ndarray, "n d"]:
    """Return the descriptors of the scans called `names` as float32.

    Raises ValueError, with the method and the scan, if there is not one vector for each scan, or if one has values that
    are not finite or only zeros.
    """
    if descriptors.ndim != 2 or len(descriptors) != len(names):
        raise ValueError(f"{method}: expected {len(names)} descriptors ({len(names)}, d), found {descriptors.shape}")
    broken, empty = ~np.isfinite(descriptors).all(axis=1), ~descriptors.any(axis=1)
    for bad, what in ((broken, "values that are not finite"), (empty, "only zeros")):
        if bad.any():
            raise ValueError(f"{method}: expected a descriptor of {names[int(bad.argmax())]}, found {what}")
    return descriptors.astype(np.float32)
