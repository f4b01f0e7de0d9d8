"""LiDAR place recognition in JAX: the public API.

    grid = params.config.grid
    bev = sglpr_jax.rasterize(points, grid=grid)      # scan (n, 3), metres -> image (h, w)
    descriptor = sglpr_jax.describe(params, bev)      # image -> 256 numbers of unit length

Everything below is a pure function or a frozen value; the rest of the package is for training and evaluation.
"""

from sglpr_jax.bev import Grid, count_outside, rasterize, rasterize_labels, rotate_image, rotate_points
from sglpr_jax.data import open_sequence, read_scan, sequence_names
from sglpr_jax.labels import CATEGORIES, label_map, to_classes
from sglpr_jax.models.config import HeadConfig, ModelConfig
from sglpr_jax.models.params import load, save
from sglpr_jax.models.presets import MODELS, model_preset
from sglpr_jax.models.sglpr import Outputs, Params, describe, forward, init, segment
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.embed import embed

__version__ = "0.1.0"

__all__ = [
    "CATEGORIES",
    "MODELS",
    "DescriptorFile",
    "Grid",
    "HeadConfig",
    "ModelConfig",
    "Outputs",
    "Params",
    "count_outside",
    "describe",
    "embed",
    "forward",
    "init",
    "label_map",
    "load",
    "model_preset",
    "open_sequence",
    "rasterize",
    "rasterize_labels",
    "read_scan",
    "rotate_image",
    "rotate_points",
    "save",
    "segment",
    "sequence_names",
    "to_classes",
]
