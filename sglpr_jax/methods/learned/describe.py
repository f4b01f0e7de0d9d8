"""Descriptors of prepared inputs by a learned method, and their distances, for arrays of any size.

A descriptor file states a learned distance as `METHOD:WEIGHTS#HASH`: the folder of the weights, or `random:SEED`, and
the beginning of their hash. The distance can be computed as long as this folder holds these weights.
"""

import functools
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float32, Shaped

from sglpr_jax.methods.learned.method import LearnedMethod, Variables
from sglpr_jax.methods.learned.weights_file import RANDOM, load_variables, variables_hash
from sglpr_jax.methods.method import DistanceFn, check_descriptors
from sglpr_jax.methods.pairwise import in_blocks, l2

BATCH = 16
"""Number of inputs that are described at a time."""
BLOCK = 512
"""Number of descriptors on each side of a block of distances."""
HASH_LENGTH = 12
"""Number of characters of the hash in the name of a distance."""


@functools.partial(jax.jit, static_argnames="method")
def apply_network(variables: Variables, inputs: Shaped[Any, "b ..."], *, method: LearnedMethod) -> Any:
    """Return the descriptors of inputs, in evaluation mode."""
    return method.network.apply(variables, inputs, train=False)


def describe_inputs(
    method: LearnedMethod, variables: Variables, inputs: Shaped[np.ndarray, "n ..."]
) -> Float32[np.ndarray, "n d"]:
    """Return the descriptors of all inputs, which may be a memory-mapped file. Raises as `check_descriptors`."""
    batches = []
    for start in range(0, len(inputs), BATCH):
        rows = np.asarray(inputs[start : start + BATCH])
        padded = np.concatenate([rows, np.repeat(rows[-1:], BATCH - len(rows), axis=0)])
        batches.append(np.asarray(apply_network(variables, padded, method=method))[: len(rows)])
    descriptors = np.concatenate(batches).astype(np.float32)
    check_descriptors(method.name, descriptors, [f"input {row}" for row in range(len(inputs))])
    return descriptors


def learned_distance(method: LearnedMethod, variables: Variables) -> DistanceFn:
    """Return the distance of a method with these weights, or L2 if the method has no distance of its own."""
    if method.compare is None:
        return l2
    compare = jax.jit(functools.partial(method.compare, variables))

    def compare_block(queries: tuple[Any, int], database: tuple[Any, int]) -> np.ndarray:
        (padded_queries, q), (padded_database, n) = queries, database
        return np.asarray(compare(padded_queries, padded_database))[:q, :n]

    return functools.partial(in_blocks, compare_block, block=BLOCK, prepare=_padded)


def stated_distance(method: str, weights: str, weights_hash: str) -> str:
    """Return the name of a learned distance. Folders become absolute, for other working folders."""
    source = weights if weights.startswith(RANDOM) else str(Path(weights).absolute())
    return f"{method}:{source}#{weights_hash[:HASH_LENGTH]}"


@functools.lru_cache(maxsize=4)
def distance_of_weights(method: LearnedMethod, name: str) -> DistanceFn:
    """Return the distance that `stated_distance` has named.

    Raises:
      FileNotFoundError: If the folder of the weights does not exist any more.
      ValueError: If it holds other weights.
    """
    weights, _, stated_hash = name.removeprefix(f"{method.name}:").rpartition("#")
    variables = load_variables(weights, method)
    if variables_hash(variables)[:HASH_LENGTH] != stated_hash:
        raise ValueError(f"{weights}: expected the weights {stated_hash} that made the descriptors, found others")
    return learned_distance(method, variables)


def _padded(rows: Float32[np.ndarray, "n d"]) -> tuple[Float32[np.ndarray, "m d"], int]:
    """Return the rows, padded to a power of two so that few sizes are compiled, and their number."""
    missing = 2 ** max(len(rows) - 1, 0).bit_length() - len(rows)
    return np.pad(rows, ((0, missing), (0, 0))), len(rows)
