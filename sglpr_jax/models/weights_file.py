"""Weights and their configuration on disk: a folder with config.json and model.safetensors, for all networks."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors

from sglpr_jax.data.formats.tensors import hash_of, tensors_as_bytes
from sglpr_jax.files import check_holds_only, in_short, json_text, read_json, replacing
from sglpr_jax.models.config import config_from_dict
from sglpr_jax.models.sglpr import weight_shapes
from sglpr_jax.models.shipped import weights_folder
from sglpr_jax.models.weights import Params, as_tree, by_name

CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"
LAST_WEIGHTS = "weights"
"""Folder of the last weights in the folder of a training run."""
VALUES_HASH = "sha256"
"""Key in the header of the weights file: `hash_of` the stored arrays."""
CONFIG_HASH = "config_sha256"
"""Key in the header of the weights file: hash of the configuration that the weights were saved with."""
LARGEST_FLOAT16 = np.finfo(np.float16).max


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
    arrays = {name: np.asarray(weight) for name, weight in by_name(params.weights).items()}
    check_arrays(arrays, weight_shapes(params.config), source=folder)
    if half:
        for name, array in arrays.items():
            if np.abs(array).max(initial=0) > LARGEST_FLOAT16:
                expected = f"values up to {LARGEST_FLOAT16}, the limit of float16"
                raise ValueError(f"{name}: expected {expected}, found larger values")
            arrays[name] = array.astype(np.float16)
    write_weights(folder, arrays, config, {CONFIG_HASH: _config_hash(config)})
    return folder


def write_weights(
    folder: Path, arrays: Mapping[str, Any], config: Mapping[str, Any], header: Mapping[str, str]
) -> None:
    """Write arrays, their hash and a configuration: all or nothing. Raises OSError if the folder holds other files."""
    # safetensors writes memory in its physical order, so a transposed view would be read in the wrong order.
    arrays = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    check_holds_only(folder, (CONFIG_FILE, WEIGHTS_FILE))
    with replacing(folder) as new:
        new.mkdir()
        content = tensors_as_bytes(arrays, {VALUES_HASH: hash_of(arrays), **header})
        (new / WEIGHTS_FILE).write_bytes(content)  # safetensors.save_file hides the OSError of a full disk
        (new / CONFIG_FILE).write_text(json_text(config))


def load(weights: Path | str) -> Params:
    """Load weights that ship with the package or that `save` has written, as float32.

    Arguments:
      weights: A name from `shipped_weights()`, a folder written by `save`, or the folder of a training run (its last
        weights). Names take precedence. Write a folder with the same name as "./NAME".

    Raises:
      FileNotFoundError: If neither exists, or if a file is missing.
      ValueError: If a file is damaged, or if the weights were saved with another configuration.
    """
    folder = last_weights(weights_folder(weights))
    stored_config = read_json(folder / CONFIG_FILE)
    config = config_from_dict(stored_config, source=folder / CONFIG_FILE)
    path = folder / WEIGHTS_FILE
    arrays, header = read_tensors(path)
    arrays = {name: array.astype(np.float32) if array.dtype == np.float16 else array for name, array in arrays.items()}
    # In older files, `stored_config` lacks fields that `config` has, so either hash may be in the header. If one is,
    # the shapes fit, and half a second for computing the expected shapes is saved.
    config_hashes = {_config_hash(stored_config), _config_hash(dataclasses.asdict(config))}
    if header.get(CONFIG_HASH) not in config_hashes:
        check_arrays(arrays, weight_shapes(config), source=path)
        if CONFIG_HASH in header:  # files of earlier versions have none
            raise ValueError(f"{path}: expected the {CONFIG_FILE} that it was saved with, found a changed one")
    return Params(jax.device_put(as_tree(arrays)), config)  # JAX would copy arrays of NumPy in every call


def last_weights(folder: Path) -> Path:
    """Return `folder`, or its subfolder `weights` if it has one. Raises FileNotFoundError if files are missing."""
    folder = folder / LAST_WEIGHTS if (folder / LAST_WEIGHTS).is_dir() else folder
    for name in (CONFIG_FILE, WEIGHTS_FILE):
        if not (folder / name).is_file():
            expected = f"a folder with {CONFIG_FILE} and {WEIGHTS_FILE}"
            raise FileNotFoundError(f"{folder}: expected {expected}, {name} is missing")
    return folder


def read_tensors(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read the arrays and the header of a safetensors file. Raises ValueError if it is damaged or has another hash."""
    try:
        with safetensors.safe_open(path, framework="np") as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
            header = file.metadata() or {}
    except (safetensors.SafetensorError, UnicodeDecodeError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path}: expected a whole safetensors file, found a damaged one ({in_short(error)})"
        ) from error
    if header:
        stored, found = header.get(VALUES_HASH, "none"), hash_of(arrays)
        if found != stored:
            raise ValueError(f"{path}: expected weights with the SHA-256 of the header, {stored}, found {found}")
    return arrays, header


def check_arrays(arrays: Mapping[str, Any], expected: Mapping[str, Any], *, source: Path) -> None:
    """Raise ValueError unless arrays (or `jax.ShapeDtypeStruct`) are finite and have the expected shapes and types."""

    def type_and_shape(array: Any) -> str:
        return "no array" if array is None else f"{array.dtype} {tuple(array.shape)}"

    for name in sorted(arrays.keys() | expected.keys()):
        array, expected_text = arrays.get(name), type_and_shape(expected.get(name))
        if type_and_shape(array) != expected_text:
            raise ValueError(f"{source}: expected {name} as {expected_text}, found {type_and_shape(array)}")
        if isinstance(array, np.ndarray) and array.dtype.kind == "f" and not np.isfinite(array).all():
            infinite = array.size - np.isfinite(array).sum()
            found = f"{infinite} of {array.size} not finite in {name}"
            raise ValueError(f"{source}: expected finite weights, found {found}")


def _config_hash(config: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()
