"""Weights on disk: a folder with config.json and model.safetensors, so that they never travel without their model."""

import dataclasses
import hashlib
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import flax.traverse_util
import jax
import numpy as np
import safetensors
import safetensors.numpy

from sglpr_jax.bev import Grid
from sglpr_jax.files import writing
from sglpr_jax.models.config import HeadConfig, ModelConfig, RingConfig
from sglpr_jax.models.sglpr import Params, init
from sglpr_jax.models.shipped import weights_folder

CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"


def save(params: Params, folder: Path | str, *, half: bool = False) -> Path:
    """Write weights and configuration under a temporary name, then put them in the place of `folder`.

    With `half` as float16, in half the room. Raises OSError, naming `folder`, where they cannot be written, ValueError
    for a weight too large for float16.
    """
    folder = Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    # safetensors writes an array's memory as it lies, so a transposed view would come back scrambled.
    flat = {name: np.asarray(leaf, order="C") for name, leaf in _flatten(params.weights).items()}
    flat = {name: _halved(name, leaf) for name, leaf in flat.items()} if half else flat
    with writing(folder), tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as scratch:
        new, old = Path(scratch) / "new", Path(scratch) / "old"
        new.mkdir()
        (new / WEIGHTS_FILE).write_bytes(safetensors.numpy.save(flat))  # save_file hides the OSError of a full disk
        (new / CONFIG_FILE).write_text(json.dumps(dataclasses.asdict(params.config), indent=2) + "\n")
        if folder.exists():
            os.replace(folder, old)
        os.replace(new, folder)
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
        flat = safetensors.numpy.load_file(folder / WEIGHTS_FILE)
    except safetensors.SafetensorError as error:
        raise ValueError(f"{folder / WEIGHTS_FILE}: not a whole safetensors file ({error})") from error
    return Params(_match(flat, config, source=folder / WEIGHTS_FILE), config)


def for_places(params: Params) -> Params:
    """The part that `describe` computes with, to hand out: no segmentation head and nothing that feeds it alone."""
    if not params.config.segments:
        return params
    config = dataclasses.replace(params.config, categories=0)
    flat = _flatten(params.weights)
    kept = {name: flat[name] for name in _shapes(config)}
    return Params(flax.traverse_util.unflatten_dict(kept, sep="/"), config)


def graft(given: Params, fresh: Params) -> Params:
    """`fresh` with the values of `given` wherever that has them: to train on from weights handed out.

    Raises ValueError where `given` has a weight that `fresh` has not, or one of another shape.
    """
    flat, values = _flatten(fresh.weights), _flatten(given.weights)
    for name, value in values.items():
        if name not in flat or flat[name].shape != value.shape:
            wanted = flat[name].shape if name in flat else "no such weight"
            raise ValueError(f"cannot begin with these weights: {name} has shape {value.shape}, expected {wanted}")
    return dataclasses.replace(fresh, weights=flax.traverse_util.unflatten_dict(flat | values, sep="/"))


def config_from_dict(values: dict[str, Any], *, source: Path | str) -> ModelConfig:
    """The model configuration that `dataclasses.asdict` made, tuples restored. Errors name `source`.

    Weights of before there were several label maps say `classes`, always 20, for `categories`.
    """
    values = {"categories" if name == "classes" else name: value for name, value in values.items()}
    try:
        grid, head = Grid(**values["grid"]), HeadConfig(**_tuples(values["head"]))
        rings = RingConfig(**_tuples(values["rings"])) if values.get("rings") else None
        return ModelConfig(**_tuples({**values, "grid": grid, "head": head, "rings": rings}))
    except (KeyError, TypeError) as error:
        raise ValueError(f"{source}: expected the fields of a ModelConfig, found {sorted(values)} ({error})") from error
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error


def weights_hash(params: Params) -> str:
    """SHA-256 over names, shapes and values of all weights, so that a result can say which weights made it."""
    digest = hashlib.sha256()
    for name, leaf in sorted(_flatten(params.weights).items()):
        digest.update(f"{name} {leaf.shape} {leaf.dtype}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def _flatten(weights: Any) -> dict[str, Any]:
    return flax.traverse_util.flatten_dict(weights, sep="/")


def _halved(name: str, leaf: np.ndarray) -> np.ndarray:
    largest = np.finfo(np.float16).max
    if np.abs(leaf).max(initial=0) > largest:
        raise ValueError(f"{name}: expected weights up to {largest} to be written as float16, found larger ones")
    return leaf.astype(np.float16)


def _tuples(values: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def _read_json(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text())
    except ValueError as error:  # not JSON, or not even text
        raise ValueError(f"{path}: expected JSON ({error})") from error
    if not isinstance(values, dict):
        raise ValueError(f"{path}: expected JSON with the fields of a ModelConfig, found {values!r:.40}")
    return values


def _match(flat: dict[str, np.ndarray], config: ModelConfig, *, source: Path) -> Any:
    """The tree of weights, in float32, after checking it against the shapes that the configuration asks for."""
    expected = _shapes(config)
    found = {name: leaf.shape for name, leaf in flat.items()}
    if expected != found:
        name = sorted(set(expected.items()) ^ set(found.items()))[0][0]
        raise ValueError(
            f"{source}: not the weights of its configuration: {name} should have shape "
            f"{expected.get(name, 'none (no such weight)')}, found {found.get(name, 'none (missing)')}"
        )
    single = {name: np.asarray(leaf, np.float32) for name, leaf in flat.items()}
    return flax.traverse_util.unflatten_dict(single, sep="/")


def _shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """The shape of every weight that the configuration asks for."""
    fresh = jax.eval_shape(lambda: init(jax.random.key(0), config=config))
    return {name: leaf.shape for name, leaf in _flatten(fresh.weights).items()}
