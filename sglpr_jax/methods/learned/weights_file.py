"""Weights of learned methods: random ones, and those in a folder with config.json and model.safetensors."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors

from sglpr_jax.data.formats.tensors import tensors_as_bytes
from sglpr_jax.data.recording import Record
from sglpr_jax.files import check_holds_only, in_short, json_text, read_json, replacing
from sglpr_jax.methods.learned.method import LearnedMethod, Variables
from sglpr_jax.models.weights import as_tree, by_name, hash_of

CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"
LAST = "weights"
"""Folder of the last weights of a training run. Earlier ones are in `weights-IMAGES`."""
RANDOM = "random:"
"""Prefix of a seed that stands for weights: `random:0` are those of an untrained network."""


def weight_count(variables: Variables) -> int:
    """Return the number of trained weights. The statistics of batch normalisation do not count."""
    return sum(leaf.size for leaf in jax.tree.leaves(variables["params"]))


def example_inputs(method: LearnedMethod) -> np.ndarray:
    """Return the input (1, ...) of an artificial scan. It defines the shapes of the weights."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-40, -40, -1.5), (40, 40, 5), (5000, 3)).astype(np.float32)
    labels = np.full(len(points), 50, np.int32)  # buildings
    return method.prepare(Record(points=points, labels=labels, name="the artificial scan"))[None]


def random_variables(method: LearnedMethod, *, seed: int) -> Variables:
    """Return the variables of an untrained network, drawn from `seed`."""
    init = jax.jit(lambda key, inputs: method.network.init(key, inputs, train=False))
    return init(jax.random.key(seed), example_inputs(method))


def save_variables(folder: Path, method: LearnedMethod, variables: Variables, about: Mapping[str, Any]) -> None:
    """Write the variables of a trained network, completely or not at all.

    Arguments:
      folder: New folder, or one with earlier weights, which are replaced.
      method: Method of the network.
      variables: Weights, and statistics of batch normalisation.
      about: Settings of the training and number of images seen, as JSON values.

    Raises:
      OSError: If the folder cannot be written or holds other files.
    """
    check_holds_only(folder, (CONFIG_FILE, WEIGHTS_FILE))
    values = {name: np.asarray(leaf, order="C") for name, leaf in by_name(variables).items()}
    with replacing(folder) as new:
        new.mkdir()
        (new / WEIGHTS_FILE).write_bytes(checked_tensors(values))
        (new / CONFIG_FILE).write_text(json_text({"method": method.name, **about}))


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
        return random_variables(method, seed=_seed(str(source)))
    folder = Path(source)
    folder = folder / LAST if (folder / LAST).is_dir() else folder
    for name in (CONFIG_FILE, WEIGHTS_FILE):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"{folder}: expected weights of {method.name}, {name} is missing")
    about = read_json(folder / CONFIG_FILE)
    found = about.get("method") if isinstance(about, dict) else None
    if found != method.name:
        raise ValueError(
            f"{folder}: expected weights of the method {method.name!r}, found those of {found or 'sglpr'!r}"
        )
    values = read_tensors(folder / WEIGHTS_FILE)
    init = jax.eval_shape(lambda: random_variables(method, seed=0))
    check_leaves(values, by_name(init), source=folder / WEIGHTS_FILE)
    return jax.device_put(as_tree(values))


def method_of(folder: Path) -> str | None:
    """Return the name of the learned method of a run or of weights, or None if the folder has none."""
    about = read_json(folder / CONFIG_FILE) if (folder / CONFIG_FILE).is_file() else None
    found = about.get("method") if isinstance(about, dict) else None
    return found if isinstance(found, str) else None


def checked_tensors(values: Mapping[str, np.ndarray]) -> bytes:
    """Return the content of a safetensors file of C-contiguous arrays, with their checksum for `read_tensors`."""
    return tensors_as_bytes(values, {"sha256": hash_of(values)})


def read_tensors(path: Path) -> dict[str, np.ndarray]:
    """Read a safetensors file. Raises ValueError if it is damaged or its values do not have the stored checksum."""
    try:
        with safetensors.safe_open(path, framework="np") as file:
            values = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
            stored = (file.metadata() or {}).get("sha256")
    except (safetensors.SafetensorError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path}: expected a whole safetensors file, found a damaged one ({in_short(error)})"
        ) from error
    if stored != hash_of(values):
        raise ValueError(f"{path}: expected values with the SHA-256 of the header, found others")
    return values


def check_leaves(values: Mapping[str, Any], expected: Mapping[str, Any], *, source: Path) -> None:
    """Raise ValueError unless arrays, or descriptions of them, have the expected names, shapes and types.

    Arrays must be finite.
    """
    for name in sorted(values.keys() | expected.keys()):
        wanted, found = (_described(some.get(name)) for some in (expected, values))
        if wanted != found:
            raise ValueError(f"{source}: expected {name} as {wanted}, found {found}")
        array = values[name]
        if isinstance(array, np.ndarray) and array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{source}: expected finite values of {name}, found others")


def variables_hash(variables: Variables) -> str:
    """Return the SHA-256 of names, shapes, types and values of all variables."""
    return hash_of({name: np.asarray(leaf) for name, leaf in by_name(variables).items()})


def _described(leaf: Any) -> str:
    return "no array" if leaf is None else f"{leaf.dtype} {tuple(leaf.shape)}"


def _seed(source: str) -> int:
    number = source.removeprefix(RANDOM)
    if not number.isdecimal():
        raise ValueError(f"expected a seed after {RANDOM!r}, found {number!r}")
    return int(number)
