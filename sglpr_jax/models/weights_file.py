"""Weights on disk: a folder with config.json and model.safetensors, so that weights and configuration stay together.

The networks of other publications use the same files (`methods/learned/weights_file.py`).
"""

import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors

from sglpr_jax.data.formats.tensors import tensors_as_bytes
from sglpr_jax.files import check_holds_only, in_short, json_text, read_json, replacing
from sglpr_jax.models.config import ModelConfig, config_from_dict
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
STORED = ("F32", "F16")
"""Data types of stored weights, with their safetensors names."""


def save(params: Params, folder: Path | str, *, half: bool = False) -> Path:
    """Write weights and their configuration to a folder.

    Arguments:
      params: Model.
      folder: New folder, or one with earlier weights, which are replaced. It is written completely or not at all.
      half: Store the weights as float16, in half the space.

    Returns:
      The folder.

    Raises:
      OSError: If the folder cannot be written or holds other files. The message names the folder.
      ValueError: If a weight is not float32, is not finite, has another shape than the configuration requires, or is
        too large for float16. The message names the weight.
    """
    folder = Path(folder)
    values = {name: np.asarray(leaf) for name, leaf in by_name(params.weights).items()}
    check_holds_only(folder, (CONFIG_FILE, WEIGHTS_FILE))
    _check_shapes({name: leaf.shape for name, leaf in values.items()}, params.config, source=folder)
    for name, leaf in values.items():
        if leaf.dtype != np.float32:
            raise ValueError(f"{folder}: expected {name} as float32, found {leaf.dtype}")
        _check_finite(name, leaf, source=folder)
    values = {name: _halved(name, leaf) for name, leaf in values.items()} if half else values
    config = dataclasses.asdict(params.config)
    write_weights(folder, values, config, {CHECKED_FOR: _hash_of(config)})
    return folder


def write_weights(
    folder: Path, values: Mapping[str, np.ndarray], config: Mapping[str, Any], header: Mapping[str, str]
) -> None:
    """Write arrays with their checksum, and a configuration, to a folder, completely or not at all.

    Raises OSError if the folder cannot be written or holds other files.
    """
    check_holds_only(folder, (CONFIG_FILE, WEIGHTS_FILE))
    # safetensors writes memory in its physical order, so a transposed view would be read in the wrong order.
    ordered = {name: np.asarray(leaf, order="C") for name, leaf in values.items()}
    with replacing(folder) as new:
        new.mkdir()
        content = tensors_as_bytes(ordered, {CHECKSUM: hash_of(ordered), **header})
        (new / WEIGHTS_FILE).write_bytes(content)  # save_file hides the OSError of a full disk
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
    known = {_hash_of(stored), _hash_of(dataclasses.asdict(config))}  # fields added later are not in older files
    values = _read_tensors(folder / WEIGHTS_FILE, config, known)
    values = {name: np.asarray(leaf, np.float32) for name, leaf in values.items()}
    return Params(jax.device_put(as_tree(values)), config)  # JAX would copy arrays of NumPy in every call


def last_weights(folder: Path) -> Path:
    """Return a folder of weights, or that of the last weights of a training run. Raises FileNotFoundError if a file is
    missing."""
    folder = folder / LAST if (folder / LAST).is_dir() else folder
    for name in (CONFIG_FILE, WEIGHTS_FILE):
        if not (folder / name).is_file():
            raise FileNotFoundError(
                f"{folder}: expected a folder with {CONFIG_FILE} and {WEIGHTS_FILE}, {name} is missing"
            )
    return folder


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a safetensors file. Raises ValueError if the file is damaged, also from the block."""
    try:
        with safetensors.safe_open(path, framework="np") as file:
            yield file
    except (safetensors.SafetensorError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path}: expected a whole safetensors file, found a damaged one ({in_short(error)})"
        ) from error


def check_checksum(values: Mapping[str, np.ndarray], metadata: Mapping[str, str], *, source: Path) -> None:
    """Raise ValueError unless the values have the checksum in the header of their file."""
    said, found = metadata.get(CHECKSUM, "none"), hash_of(values)
    if said != found:
        raise ValueError(f"{source}: expected weights with the SHA-256 of the header, {said}, found {found}")


def _read_tensors(path: Path, config: ModelConfig, known: Collection[str]) -> dict[str, np.ndarray]:
    """Read the stored weights and check their names, shapes, types, values and checksums.

    `known` are the checksums of the configuration.
    """
    with opened(path) as file:
        about = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        metadata = file.metadata() or {}
        if metadata.get(CHECKED_FOR) not in known:
            _check_shapes({name: tuple(part.get_shape()) for name, part in about.items()}, config, source=path)
            if CHECKED_FOR in metadata:  # files of earlier versions have none
                raise ValueError(f"{path}: expected the {CONFIG_FILE} that it was saved with, found a changed one")
        for name, part in about.items():
            if part.get_dtype() not in STORED or 0 in part.get_shape():
                found = f"{part.get_dtype()} {tuple(part.get_shape())}"
                raise ValueError(f"{path}: expected {name} as {' or '.join(STORED)} with values, found {found}")
        values = {name: file.get_tensor(name) for name in about}
    for name, leaf in values.items():
        _check_finite(name, leaf, source=path)
    if metadata:  # files of earlier versions have none
        check_checksum(values, metadata, source=path)
    return values


def _hash_of(config: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()


def _check_shapes(found: Mapping[str, tuple[int, ...]], config: ModelConfig, *, source: Path) -> None:
    """Raise ValueError if names or shapes differ from the configuration. The message names one such weight."""
    expected = weight_shapes(config)
    if expected != found:
        name = min(set(expected.items()) ^ set(found.items()))[0]
        raise ValueError(
            f"{source}: expected the weights of its configuration, {name} of shape "
            f"{expected.get(name, 'none (unknown weight)')}, found {found.get(name, 'none (missing)')}"
        )


def _check_finite(name: str, leaf: np.ndarray, *, source: Path) -> None:
    broken = leaf.size - int(np.isfinite(leaf).sum())
    if broken:
        raise ValueError(f"{source}: expected finite weights, found {broken} of {leaf.size} not finite in {name}")


def _halved(name: str, leaf: np.ndarray) -> np.ndarray:
    largest = np.finfo(np.float16).max
    if np.abs(leaf).max(initial=0) > largest:
        raise ValueError(f"{name}: expected values up to {largest}, the limit of float16, found larger values")
    return leaf.astype(np.float16)
