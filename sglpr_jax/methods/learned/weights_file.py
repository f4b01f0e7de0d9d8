"""Weights of learned methods: random ones, and those in files, which are the same as for models."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sglpr_jax.data.scan import Scan
from sglpr_jax.files import read_json
from sglpr_jax.methods.learned.method import LearnedMethod, Variables
from sglpr_jax.models.weights import as_tree, by_name, hash_of
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
