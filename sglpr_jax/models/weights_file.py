"""Weights on disk: a folder with config.json and model.safetensors, so that weights and configuration stay together.

The networks of other publications use the same files (`methods/learned/weights_file.py`).
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors

from sglpr_jax.data.formats.tensors import tensors_as_bytes
from sglpr_jax.files import check_holds_only, in_short, json_text, read_json, replacing
from sglpr_jax.models.config import config_from_dict
from sglpr_jax.models.params import Params
from sglpr_jax.models.shipped import weights_folder
from sglpr_jax.models.weights import as_tree, by_name, hash_of, weight_shapes

CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"
LAST = "weights"
"""Folder of the last weights in the folder of a training run."""
CHECKSUM = "sha256"
"""Key in the header of the weights file for the `hash_of` the stored values."""
CHECKED_FOR = "config_sha256"
"""Key in the header for the checksum of the configuration that the weights were saved with. If it matches, the expected
shapes need not be computed, which saves half a second."""
LARGEST = np.finfo(np.float16).max


def save(params: Params, folder: Path | str, *, half: bool = False) -> Path:
    """Write weights and their configuration to a folder.

    Arguments:
      params: Model.
      folder: New folder, or one with earlier weights, which are replaced. It is written completely or not at all.
      half: Store the weights as float16, in half the space.

    Returns:
      The folder.

    Raises:
      OSError: If the folder cannot be written or holds other files.
      ValueError: If a weight is not float32, is not finite, has another shape than the configuration requires, or is
        too large for float16.
    """
    folder, config = Path(folder), dataclasses.asdict(params.config)
    values = {name: np.asarray(leaf) for name, leaf in by_name(params.weights).items()}
    check_leaves(values, weight_shapes(params.config), source=folder)
    for name, leaf in values.items() if half else ():
        if np.abs(leaf).max(initial=0) > LARGEST:
            raise ValueError(f"{name}: expected values up to {LARGEST}, the limit of float16, found larger values")
        values[name] = leaf.astype(np.float16)
    write_weights(folder, values, config, {CHECKED_FOR: _hash_of(config)})
    return folder


def write_weights(
    folder: Path, values: Mapping[str, Any], config: Mapping[str, Any], header: Mapping[str, str]
) -> None:
    """Write arrays with their checksum, and a configuration, to a folder, completely or not at all.

    Raises OSError if the folder cannot be written or holds other files.
    """
    # safetensors writes memory in its physical order, so a transposed view would be read in the wrong order.
    values = {name: np.asarray(leaf, order="C") for name, leaf in values.items()}
    check_holds_only(folder, (CONFIG_FILE, WEIGHTS_FILE))
    with replacing(folder) as new:
        new.mkdir()
        content = tensors_as_bytes(values, {CHECKSUM: hash_of(values), **header})
        (new / WEIGHTS_FILE).write_bytes(content)  # safetensors.save_file hides the OSError of a full disk
        (new / CONFIG_FILE).write_text(json_text(config))


def load(weights: Path | str) -> Params:
    """Load weights that ship with the package, by name, or weights written by `save`, by folder.

    For the directory of a training run, its `weights` folder is read. The values are converted to float32.

    Arguments:
      weights: A name from `shipped_weights()`, or a folder. Names take precedence. Write a folder with the same name as
        "./NAME".

    Raises:
      FileNotFoundError: If neither exists, or if a file is missing.
      ValueError: If a file is damaged, or if the weights were saved with another configuration.
    """
    folder = last_weights(weights_folder(weights))
    stored = read_json(folder / CONFIG_FILE)
    config = config_from_dict(stored, source=folder / CONFIG_FILE)
    # The hash of the stored values counts, too, because older files lack fields that were added later.
    config_hashes = {_hash_of(stored), _hash_of(dataclasses.asdict(config))}
    path = folder / WEIGHTS_FILE
    values, header = read_tensors(path)
    values = {name: leaf.astype(np.float32) if leaf.dtype == np.float16 else leaf for name, leaf in values.items()}
    if header.get(CHECKED_FOR) not in config_hashes:
        check_leaves(values, weight_shapes(config), source=path)
        if CHECKED_FOR in header:  # files of earlier versions have none
            raise ValueError(f"{path}: expected the {CONFIG_FILE} that it was saved with, found a changed one")
    return Params(jax.device_put(as_tree(values)), config)  # JAX would copy arrays of NumPy in every call


def last_weights(folder: Path) -> Path:
    """Return a folder of weights, or that of the last weights of a training run.

    Raises FileNotFoundError if a file is missing.
    """
    folder = folder / LAST if (folder / LAST).is_dir() else folder
    for name in (CONFIG_FILE, WEIGHTS_FILE):
        if not (folder / name).is_file():
            expected = f"expected a folder with {CONFIG_FILE} and {WEIGHTS_FILE}"
            raise FileNotFoundError(f"{folder}: {expected}, {name} is missing")
    return folder


def read_tensors(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read the arrays and the header of a safetensors file.

    Raises ValueError if the file is damaged, or if its arrays do not have the checksum of the header. Files of earlier
    versions have no header.
    """
    try:
        with safetensors.safe_open(path, framework="np") as file:
            values = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
            header = file.metadata() or {}
    except (safetensors.SafetensorError, UnicodeDecodeError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path}: expected a whole safetensors file, found a damaged one ({in_short(error)})"
        ) from error
    if header and (stored := header.get(CHECKSUM, "none")) != (found := hash_of(values)):
        raise ValueError(f"{path}: expected weights with the SHA-256 of the header, {stored}, found {found}")
    return values, header


def check_leaves(values: Mapping[str, Any], expected: Mapping[str, Any], *, source: Path) -> None:
    """Raise ValueError unless arrays, or descriptions of them, have the expected names, shapes and types and are
    finite."""

    def described(array: Any) -> str:
        return "no array" if array is None else f"{array.dtype} {tuple(array.shape)}"

    for name in sorted(values.keys() | expected.keys()):
        wanted, array = described(expected.get(name)), values.get(name)
        if wanted != described(array):
            raise ValueError(f"{source}: expected {name} as {wanted}, found {described(array)}")
        if isinstance(array, np.ndarray) and array.dtype.kind == "f" and not np.isfinite(array).all():
            broken = array.size - np.isfinite(array).sum()
            raise ValueError(f"{source}: expected finite weights, found {broken} of {array.size} not finite in {name}")


def _hash_of(config: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()
