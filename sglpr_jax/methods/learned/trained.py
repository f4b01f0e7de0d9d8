"""Learned methods with their weights: files of weights, descriptors of prepared inputs, and learned distances.

A descriptor file names a learned distance `METHOD:WEIGHTS#HASH`: the folder of the weights, or `random:SEED`, and the
beginning of their SHA-256. The distance can be computed while this folder holds these weights.
"""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float32, Shaped

from sglpr_jax.data.formats.tensors import hash_of
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import read_json
from sglpr_jax.methods.learned.method import LearnedMethod, Variables
from sglpr_jax.methods.method import DistanceFn, check_descriptors
from sglpr_jax.methods.pairwise import in_blocks, l2
from sglpr_jax.models.weights import as_tree, by_name
from sglpr_jax.models.weights_file import (
    CONFIG_FILE,
    WEIGHTS_FILE,
    check_arrays,
    last_weights,
    read_tensors,
    write_weights,
)

COLLECTIONS = ["params", "batch_stats"]
"""Collections of a network's variables in Flax."""
RANDOM = "random:"
"""Prefix of a name of weights: `random:0` names those of an untrained network, drawn from the seed 0."""
BATCH = 16
"""Number of inputs that are described at a time."""
BLOCK = 512
"""Number of queries, and of database descriptors, in a block of distances."""
HASH_LENGTH = 12
"""Number of characters of the hash in the name of a distance."""


def example_inputs(method: LearnedMethod) -> np.ndarray:
    """Return the input (1, ...) of an artificial scan, whose shape defines the shapes of the weights."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-40, -40, -1.5), (40, 40, 5), (5000, 3)).astype(np.float32)
    labels = np.full(len(points), 50, np.int32)  # buildings
    return method.prepare(Scan(points=points, labels=labels, name="the artificial scan"))[None]


def random_variables(method: LearnedMethod, *, seed: int) -> Variables:
    """Return the variables of an untrained network, drawn from `seed`."""
    init = jax.jit(lambda key, inputs: method.network.init(key, inputs, train=False, mutable=COLLECTIONS))
    return init(jax.random.key(seed), example_inputs(method))


def save_variables(folder: Path, method: LearnedMethod, variables: Variables, about: Mapping[str, Any]) -> None:
    """Write the variables of a network, and the settings of its training as JSON values. Raises as `write_weights`."""
    write_weights(folder, by_name(variables), {"method": method.name, **about}, {})


def load_variables(source: Path | str, method: LearnedMethod) -> Variables:
    """Return the variables of a method.

    Arguments:
      source: Folder written by `save_variables`, folder of a training run (its last weights), or `random:SEED`.
      method: Method of the weights.

    Raises:
      FileNotFoundError: If the folder or one of its files is missing.
      ValueError: If the weights belong to another method, or if arrays are missing, unknown, of another shape, damaged
        or not finite.
    """
    if str(source).startswith(RANDOM):
        seed = str(source).removeprefix(RANDOM)
        if not seed.isdecimal():
            raise ValueError(f"expected a seed after {RANDOM!r}, found {seed!r}")
        return random_variables(method, seed=int(seed))
    folder = last_weights(Path(source))
    stored_method = method_of(folder) or "sglpr"
    if stored_method != method.name:
        raise ValueError(f"{folder}: expected weights of the method {method.name!r}, found those of {stored_method!r}")
    arrays, _ = read_tensors(folder / WEIGHTS_FILE)
    expected = by_name(jax.eval_shape(lambda: random_variables(method, seed=0)))
    check_arrays(arrays, expected, source=folder / WEIGHTS_FILE)
    return jax.device_put(as_tree(arrays))


def method_of(folder: Path) -> str | None:
    """Return the name of the learned method in the config.json of a folder of a run or of weights, or None."""
    about = read_json(folder / CONFIG_FILE) if (folder / CONFIG_FILE).is_file() else None
    name = about.get("method") if isinstance(about, dict) else None
    return name if isinstance(name, str) else None


def variables_hash(variables: Variables) -> str:
    """Return the SHA-256 of names, shapes, types and values of all variables."""
    return hash_of({name: np.asarray(leaf) for name, leaf in by_name(variables).items()})


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
