"""Weights on disk: a folder with config.json and model.safetensors, so that they never travel without their model."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from sglpr_jax.files import replacing
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.config_dict import config_from_dict
from sglpr_jax.models.params import Params
from sglpr_jax.models.shipped import weights_folder
from sglpr_jax.models.weights import as_tree, by_name, weight_shapes

CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"


def save(params: Params, folder: Path | str, *, half: bool = False) -> Path:
    """Write weights and their configuration into `folder`, whole or not at all; one that is there is replaced.

    With `half` as float16, in half the room. Raises OSError, naming `folder`, where they cannot be written, ValueError
    for a weight too large for float16.
    """
    folder = Path(folder)
    # safetensors writes an array's memory as it lies, so a transposed view would come back scrambled.
    values = {name: np.asarray(leaf, order="C") for name, leaf in by_name(params.weights).items()}
    values = {name: _halved(name, leaf) for name, leaf in values.items()} if half else values
    with replacing(folder) as new:
        new.mkdir()
        (new / WEIGHTS_FILE).write_bytes(safetensors.numpy.save(values))  # save_file hides the OSError of a full disk
        (new / CONFIG_FILE).write_text(json.dumps(dataclasses.asdict(params.config), indent=2) + "\n")
    return folder


def load(weights: Path | str) -> Params:
    """Weights that ship with the package, by name (`shipped_weights()`), or what `save` wrote, by folder; float32.

    A training run's directory works too: its `weights` folder is read. A name goes before a folder of the same name,
    which is "./NAME". Raises FileNotFoundError when there is neither or a file is missing, ValueError when it is
    damaged or the weights are not those of the configuration.
    """
    folder = weights_folder(weights)
    if (folder / "weights").is_dir():
        folder = folder / "weights"
    for name in (CONFIG_FILE, WEIGHTS_FILE):
        if not (folder / name).is_file():
            raise FileNotFoundError(
                f"{folder}: expected a folder with {CONFIG_FILE} and {WEIGHTS_FILE}, {name} is missing"
            )
    config = config_from_dict(_read_json(folder / CONFIG_FILE), source=folder / CONFIG_FILE)
    try:
        values = safetensors.numpy.load_file(folder / WEIGHTS_FILE)
    except safetensors.SafetensorError as error:
        raise ValueError(f"{folder / WEIGHTS_FILE}: not a whole safetensors file ({error})") from error
    return Params(_checked(values, config, source=folder / WEIGHTS_FILE), config)


def _halved(name: str, leaf: np.ndarray) -> np.ndarray:
    largest = np.finfo(np.float16).max
    if np.abs(leaf).max(initial=0) > largest:
        raise ValueError(f"{name}: expected weights up to {largest} to be written as float16, found larger ones")
    return leaf.astype(np.float16)


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except ValueError as error:  # not JSON, or not even text
        raise ValueError(f"{path}: expected JSON ({error})") from error


def _checked(values: dict[str, np.ndarray], config: ModelConfig, *, source: Path) -> Any:
    """The tree of weights, in float32, after checking it against the shapes that the configuration asks for."""
    expected = weight_shapes(config)
    found = {name: leaf.shape for name, leaf in values.items()}
    if expected != found:
        name = sorted(set(expected.items()) ^ set(found.items()))[0][0]
        raise ValueError(
            f"{source}: not the weights of its configuration: {name} should have shape "
            f"{expected.get(name, 'none (no such weight)')}, found {found.get(name, 'none (missing)')}"
        )
    return as_tree({name: np.asarray(leaf, np.float32) for name, leaf in values.items()})
