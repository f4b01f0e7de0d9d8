"""Descriptors of prepared inputs by a learned method, and their distances, for arrays of any size.

A descriptor file names a learned distance `METHOD:WEIGHTS#HASH`: the folder of the weights, or `random:SEED`, and the
beginning of their SHA-256. The distance can be computed while this folder holds these weights.
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
"""Number of queries, and of database descriptors, in a block of distances."""
HASH_LENGTH = 12
"""Number of characters of the hash in the name of a distance."""


@functools.partial(jax.jit, static_argnames="method")
def apply_network(variables: Variables, inputs: Shaped[Any, "b ..."], *, method: LearnedMethod) -> Any:
    """Return the descriptors of a batch of inputs, by the network in evaluation mode."""
    return method.network.apply(variables, inputs, train=False)


def describe_inputs(
    method: LearnedMethod, variables: Variables, inputs: Shaped[np.ndarray, "n ..."]
) -> Float32[np.ndarray, "n d"]:
    """Return the descriptors of all inputs, perhaps a memory-mapped file. Raises ValueError as `check_descriptors`."""
    described = []
    for start in range(0, len(inputs), BATCH):
        batch = np.asarray(inputs[start : start + BATCH])
        padded = np.concatenate([batch, np.repeat(batch[-1:], BATCH - len(batch), axis=0)])  # one size is compiled
        described.append(np.asarray(apply_network(variables, padded, method=method))[: len(batch)])
    descriptors = np.concatenate(described).astype(np.float32)
    check_descriptors(method.name, descriptors, [f"input {i}" for i in range(len(inputs))])
    return descriptors


def learned_distance(method: LearnedMethod, variables: Variables) -> DistanceFn:
    """Return the distance function of a method with these weights, or L2 if the method has no own distance."""
    if method.compare is None:
        return l2
    compare = jax.jit(functools.partial(method.compare, variables))

    def compare_block(queries: tuple[Any, int], database: tuple[Any, int]) -> np.ndarray:
        (padded_queries, query_count), (padded_database, database_count) = queries, database
        return np.asarray(compare(padded_queries, padded_database))[:query_count, :database_count]

    return functools.partial(in_blocks, compare_block, block=BLOCK, prepare=_pad_to_power_of_two)


def name_of_distance(method: str, weights: str, weights_hash: str) -> str:
    """Return `METHOD:WEIGHTS#HASH`, the name of a learned distance, with the absolute path of a folder of weights."""
    source = weights if weights.startswith(RANDOM) else str(Path(weights).absolute())
    return f"{method}:{source}#{weights_hash[:HASH_LENGTH]}"


@functools.lru_cache(maxsize=4)
def distance_named(method: LearnedMethod, name: str) -> DistanceFn:
    """Return the distance function for a name `METHOD:WEIGHTS#HASH`, as written by `name_of_distance`.

    Raises:
      FileNotFoundError: If the folder of the weights does not exist any more.
      ValueError: If it holds weights with another hash.
    """
    weights, _, expected_hash = name.removeprefix(f"{method.name}:").rpartition("#")
    variables = load_variables(weights, method)
    found_hash = variables_hash(variables)[:HASH_LENGTH]
    if found_hash != expected_hash:
        expected = f"the weights {expected_hash} that made the descriptors"
        raise ValueError(f"{weights}: expected {expected}, found {found_hash}")
    return learned_distance(method, variables)


def _pad_to_power_of_two(rows: Float32[np.ndarray, "n d"]) -> tuple[Float32[np.ndarray, "m d"], int]:
    """Return the rows and additional rows of zeros, so that few sizes are compiled, and the original number of rows."""
    padded_length = 2 ** max(len(rows) - 1, 0).bit_length()
    return np.pad(rows, ((0, padded_length - len(rows)), (0, 0))), len(rows)
