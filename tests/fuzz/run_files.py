"""Configurations, weights and what a training writes."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import safetensors.numpy

from sglpr_jax.files import read_json
from sglpr_jax.grid import Grid
from sglpr_jax.models.config import HeadConfig, ModelConfig, SwinConfig, config_from_dict
from sglpr_jax.models.weights import by_name, hash_of, weight_shapes
from sglpr_jax.models.weights_file import CHECKSUM, CONFIG_FILE, WEIGHTS_FILE, load
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.run_folder import require_same_settings

from .damage import (
    BYTES,
    Damaged,
    change_json,
    safetensors_file,
    safetensors_parts,
)
from .road import DRAWN, N, Road, as_whole, plain

CONFIG = ModelConfig(
    grid=Grid(resolution_m=3.2, height=16, width=16),
    backbone=SwinConfig(embed_dim=8, depths=(1,), heads=(2,), window=4, drop_path=0.0),
    head=HeadConfig(channels=(8,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=2, descriptor_size=8),
    categories=0,
)
CONFIG_JSON = json.dumps(dataclasses.asdict(CONFIG), indent=2).encode()


def change_value(content: bytes, draw: Random) -> Damaged:
    """JSON with one value of another type or size, one too many or one too few."""
    return Damaged(json.dumps(change_json(json.loads(content), draw)).encode(), "either")


def read_config(path: Path) -> ModelConfig:
    return config_from_dict(read_json(path), source=path)


def _same_config(found: ModelConfig, content: bytes) -> bool:
    """All that the file says is what the model is, and nothing else; the sizes are sizes."""
    values = json.loads(content)
    values["head"] = {"means": [], "whiten": False, **values["head"]}
    sizes = (found.grid.height, found.head.clusters, found.head.descriptor_size, *found.head.channels)
    good = found.grid.resolution_m > 0 and found.blind_m >= 0 and min(sizes) > 0
    return good and _equal(json.loads(json.dumps(dataclasses.asdict(found))), values)


def _equal(a: Any, b: Any) -> bool:
    """Equal in value and type; a whole number may have become a float."""
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(_equal(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(_equal, a, b))
    if (type(a), type(b)) == (float, int):
        return a == float(b)  # one of many digits is rounded
    return a == b and type(a) is type(b)


WEIGHTS = {name: DRAWN.normal(size=shape).astype(np.float32) for name, shape in weight_shapes(CONFIG).items()}


def stored(values: Mapping[str, np.ndarray]) -> bytes:
    return safetensors.numpy.save(dict(values), {CHECKSUM: hash_of(values)})


def break_tensor(content: bytes, draw: Random) -> Damaged:
    """One tensor has another shape, type or name, is missing, or not finite; the checksum fits."""
    values = dict(WEIGHTS)
    name = draw.choice(list(values))
    value = values.pop(name)
    holed = value.copy()
    holed.flat[draw.randrange(value.size)] = draw.choice((np.nan, np.inf, -np.inf))
    types = tuple(value.astype(kind) for kind in (np.float64, np.int32, np.bool_, np.uint8))
    other = draw.choice((holed, *types, value[None], value[..., :0], value.ravel()[:-1], None))
    if other is not None:
        values[name] = np.ascontiguousarray(other)
    elif draw.random() < 0.5:
        values[f"{name}_"] = value
    return Damaged(stored(values))


def change_header(content: bytes, draw: Random) -> Damaged:
    """The header of a safetensors file says something else."""
    header, body = safetensors_parts(content)
    return Damaged(safetensors_file(change_json(header, draw), body), "either")


def _line_of_metrics(step: int) -> str:
    return json.dumps({"step": step, "loss": step / 8, "score": None})


METRICS = "".join(_line_of_metrics(step) + "\n" for step in range(1, N + 1)).encode()


def change_line(content: bytes, draw: Random) -> Damaged:
    """A line of a log is of another kind, or out of order."""
    lines = content.decode().splitlines()
    strange = (
        "",
        "[]",
        "3",
        "null",
        '{"step": "2"}',
        '{"loss": 1}',
        '{"step": 2.5}',
        '{"step": 1, "step": 2}',
        "{" * 5000,
    )
    lines[draw.randrange(len(lines) - 1)] = draw.choice((*strange, _line_of_metrics(99)))
    return Damaged("\n".join(lines).encode() + b"\n")


def _same_metrics(found: list, content: bytes) -> bool:
    """The lines that stand there, but for a last one that is cut short."""
    lines = content.split(b"\n")
    said = [json.loads(line) for line in lines[:-1]]
    return found == said or (len(found) == len(said) + 1 and found == [*said, json.loads(lines[-1])])


RUN = TrainConfig(model=CONFIG)
RUN_JSON = json.dumps({"seq": "08", "config": dataclasses.asdict(RUN)}).encode()


def read_run(path: Path) -> None:
    require_same_settings(path.parent, RUN, {"seq": "08"})


def _same_weights(found: Any, content: bytes) -> bool:
    return plain(by_name(found.weights)) == plain(WEIGHTS)


ROADS = (
    Road("configuration", CONFIG_FILE, CONFIG_JSON, read_config, _same_config, {**BYTES, "value": change_value}),
    Road(
        "weights",
        WEIGHTS_FILE,
        stored(WEIGHTS),
        lambda path: load(path.parent),
        _same_weights,
        {**BYTES, "tensor": break_tensor, "header": change_header},
        {CONFIG_FILE: CONFIG_JSON},
    ),
    Road("run settings", "config.json", RUN_JSON, damages={**BYTES, "value": change_value}, **as_whole(read_run, None)),
    Road("metrics", "metrics.jsonl", METRICS, read_metrics, _same_metrics, {**BYTES, "line": change_line}),
)
