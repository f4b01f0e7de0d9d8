"""LiDAR place recognition in JAX: the public API, by task.

    params = sglpr_jax.load("sglpr")                    # weights by name, or by folder
    bev = sglpr_jax.scan_image(points, params.config)   # scan (n, 3), metres -> image (h, w)
    descriptor = sglpr_jax.describe(params, bev)        # image -> 256 numbers of unit length

- describe a place, under jit, vmap and grad: `load`, `scan_image`, `describe`, `is_describable`; `segment`, `forward`
- read recordings: `open_recording`, `recording_names`, `read_scan`, `Recording`, `Record`; `Mounting`,
  `estimate_mounting`
- find places again: `embed`, `DescriptorFile`, `nearest`; incrementally `Index`, for a fleet `FleetIndex`
- score retrieval: `evaluate`
- find loops: `find_loops` of a recording, `LoopDetector` for a stream of scans; `read_odometry`, `optimize_trajectory`;
  `PlaceMap` for scans of another day
- train: `preset`, `train`; initialise with `init`, store with `save`, publish with `for_places`, `average`,
  `save_program`
- simulate recordings with labels: `simulate`
- images and classes: `Grid`, `rasterize`, `density_bev`, `rotate_image`, `taxonomy`, `to_classes` and more
- configure a model: `ModelConfig`, its backbones `SwinConfig`, `RingConfig`, `SglprConfig`, its `HeadConfig`
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sglpr_jax.bev import count_outside, rasterize, rasterize_labels, rotate_image, rotate_points
    from sglpr_jax.data import Record, Recording, open_recording, read_scan, recording_names
    from sglpr_jax.data.density_image import density_bev
    from sglpr_jax.data.mounting import Mounting, estimate_mounting
    from sglpr_jax.evaluation.scoring import Evaluation, evaluate
    from sglpr_jax.grid import Grid
    from sglpr_jax.labels import CATEGORIES, taxonomy, to_classes
    from sglpr_jax.loops.detector import LoopDetector
    from sglpr_jax.loops.find import find_loops
    from sglpr_jax.loops.loop import Loop
    from sglpr_jax.loops.odometry import read_odometry
    from sglpr_jax.loops.optimization import optimize_trajectory
    from sglpr_jax.loops.places import PlaceMap
    from sglpr_jax.models.average import average
    from sglpr_jax.models.backbones.rings_config import RingConfig
    from sglpr_jax.models.backbones.sglpr_config import SglprConfig
    from sglpr_jax.models.backbones.swin_config import SwinConfig
    from sglpr_jax.models.config import HeadConfig, ModelConfig
    from sglpr_jax.models.params import Params
    from sglpr_jax.models.presets import MODELS, model_preset
    from sglpr_jax.models.program import save_program
    from sglpr_jax.models.sglpr import Outputs, describe, forward, init, is_describable, segment
    from sglpr_jax.models.shipped import shipped_weights
    from sglpr_jax.models.weights import for_places
    from sglpr_jax.models.weights_file import load, save
    from sglpr_jax.retrieval.descriptor_file import DescriptorFile
    from sglpr_jax.retrieval.embed import embed, scan_image
    from sglpr_jax.retrieval.fleet_index import FleetIndex
    from sglpr_jax.retrieval.index import Index
    from sglpr_jax.retrieval.nearest import Nearest, nearest
    from sglpr_jax.sim.simulation import simulate
    from sglpr_jax.training.presets import load_preset as preset
    from sglpr_jax.training.recipe import TrainResult, train

__version__ = "0.2.0"

_HOMES = {
    "bev": ("count_outside", "rasterize", "rasterize_labels", "rotate_image", "rotate_points"),
    "data": ("Record", "Recording", "open_recording", "read_scan", "recording_names"),
    "data.density_image": ("density_bev",),
    "data.mounting": ("Mounting", "estimate_mounting"),
    "evaluation.scoring": ("Evaluation", "evaluate"),
    "grid": ("Grid",),
    "labels": ("CATEGORIES", "taxonomy", "to_classes"),
    "loops.detector": ("LoopDetector",),
    "loops.find": ("find_loops",),
    "loops.loop": ("Loop",),
    "loops.odometry": ("read_odometry",),
    "loops.optimization": ("optimize_trajectory",),
    "loops.places": ("PlaceMap",),
    "models.average": ("average",),
    "models.backbones.rings_config": ("RingConfig",),
    "models.backbones.sglpr_config": ("SglprConfig",),
    "models.backbones.swin_config": ("SwinConfig",),
    "models.config": ("HeadConfig", "ModelConfig"),
    "models.params": ("Params",),
    "models.presets": ("MODELS", "model_preset"),
    "models.program": ("save_program",),
    "models.sglpr": ("Outputs", "describe", "forward", "init", "is_describable", "segment"),
    "models.shipped": ("shipped_weights",),
    "models.weights": ("for_places",),
    "models.weights_file": ("load", "save"),
    "retrieval.descriptor_file": ("DescriptorFile",),
    "retrieval.embed": ("embed", "scan_image"),
    "retrieval.fleet_index": ("FleetIndex",),
    "retrieval.index": ("Index",),
    "retrieval.nearest": ("Nearest", "nearest"),
    "sim.simulation": ("simulate",),
    "training.presets": ("preset",),
    "training.recipe": ("TrainResult", "train"),
}
"""Module that defines each public name. It is imported on first access, because importing JAX takes most of a
second."""
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
_THERE = {"preset": "load_preset"}
"""Public names that differ from the name in their module."""


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = importlib.import_module(f"{__name__}.{_HOME_OF[name]}")
    globals()[name] = getattr(home, _THERE.get(name, name))
    return globals()[name]


def __dir__() -> list[str]:
    return sorted(__all__)


__all__ = [
    "CATEGORIES",
    "MODELS",
    "DescriptorFile",
    "Evaluation",
    "FleetIndex",
    "Grid",
    "HeadConfig",
    "Index",
    "Loop",
    "LoopDetector",
    "ModelConfig",
    "Mounting",
    "Nearest",
    "Outputs",
    "Params",
    "PlaceMap",
    "Record",
    "Recording",
    "RingConfig",
    "SglprConfig",
    "SwinConfig",
    "TrainResult",
    "average",
    "count_outside",
    "density_bev",
    "describe",
    "embed",
    "estimate_mounting",
    "evaluate",
    "find_loops",
    "for_places",
    "forward",
    "init",
    "is_describable",
    "load",
    "model_preset",
    "nearest",
    "open_recording",
    "optimize_trajectory",
    "preset",
    "rasterize",
    "rasterize_labels",
    "read_odometry",
    "read_scan",
    "recording_names",
    "rotate_image",
    "rotate_points",
    "save",
    "save_program",
    "scan_image",
    "segment",
    "shipped_weights",
    "simulate",
    "taxonomy",
    "to_classes",
    "train",
]
