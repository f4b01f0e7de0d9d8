"""LiDAR place recognition in JAX: the public API.

    params = sglpr_jax.load("simulated")                # weights by name, or by folder
    bev = sglpr_jax.scan_image(points, params.config)   # scan (n, 3), metres -> image (h, w)
    descriptor = sglpr_jax.describe(params, bev)        # image -> 256 numbers of unit length

Everything below is a pure function or a frozen value; the rest of the package is for training and evaluation.
"""

from sglpr_jax.bev import Grid, count_outside, rasterize, rasterize_labels, rotate_image, rotate_points
from sglpr_jax.data import open_sequence, read_scan, sequence_names
from sglpr_jax.data.density_image import density_bev
from sglpr_jax.labels import CATEGORIES, label_map, to_classes
from sglpr_jax.models.config import HeadConfig, ModelConfig, RingConfig
from sglpr_jax.models.params import for_places, load, save
from sglpr_jax.models.presets import MODELS, model_preset
from sglpr_jax.models.sglpr import Outputs, Params, describe, forward, init, segment
from sglpr_jax.models.shipped import shipped_weights
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.embed import embed
from sglpr_jax.retrieval.scan_views import scan_image

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
    "RingConfig",
    "count_outside",
    "density_bev",
    "describe",
    "embed",
    "for_places",
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
    "scan_image",
    "segment",
    "sequence_names",
    "shipped_weights",
    "to_classes",
]
