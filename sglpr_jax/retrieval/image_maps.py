"""Bird's-eye-view maps of a scan: predicted classes of its cells, and strengths of feature maps of the network."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num
from PIL import Image

from sglpr_jax.bev import uncrop_labels
from sglpr_jax.data.formats.png import label_image_pixels
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.views import view
from sglpr_jax.files import replacing
from sglpr_jax.labels import UNLABELLED, to_raw
from sglpr_jax.models.input_image import field_of_view, from_polar
from sglpr_jax.models.sglpr import forward, segment
from sglpr_jax.models.weights import Params


class SemanticMap(NamedTuple):
    """Point counts and classes of the cells of a scan's bird's-eye-view image."""

    counts: Float[np.ndarray, "h w"]
    predicted: Int[np.ndarray, "h w"]
    """Predicted class ids; 0 for cells that are empty, outside the field of view, or uncertain."""
    truth: Int[np.ndarray, "h w"]
    """Class of the last point in each cell; 0 for cells that are empty, outside the field of view, or without a
    label."""

    @property
    def seen(self) -> Bool[np.ndarray, "h w"]:
        """Cells that have a predicted class."""
        return self.predicted != UNLABELLED


def semantic_map(params: Params, scan: Scan, *, min_confidence: float = 0.0) -> SemanticMap:
    """Predict the class of every occupied cell of a scan or a ready-made image.

    The probabilities are the mean over the image and its mirror image.

    Arguments:
      params: Weights of the model.
      scan: Scan, or ready-made image that is cropped to the model's grid. Cells above 0 are occupied. Labels of the
        scan, if any, become `SemanticMap.truth`.
      min_confidence: Minimum probability of the most probable class. Cells below it stay unlabelled.

    Example:
      found = semantic_map(params, recording.scan(0))
    """
    config = params.config
    categories = 0 if scan.labels is None else config.categories
    counts, truth = view(scan, config.grid, image=config.image, categories=categories)
    truth = jnp.zeros(counts.shape, jnp.int32) if truth is None else truth
    return SemanticMap(*jax.device_get((counts, *_predict(params, counts, truth, jnp.float32(min_confidence)))))


def save_map(path: Path, found: SemanticMap, scan: Scan, *, categories: int) -> None:
    """Write the class ids of a map as a PNG. For a ready-made image, write its label image, with 0 outside the grid."""
    if scan.image is None:
        pixels = found.predicted.astype(np.uint8)
    else:
        raw = to_raw(found.predicted, categories=categories)
        pixels = label_image_pixels(uncrop_labels(raw, shape=scan.image.shape))
    with replacing(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")


@jax.jit
def _predict(
    params: Params, counts: Float[Array, "h w"], truth: Int[Array, "h w"], min_confidence: Float[Array, ""]
) -> tuple[Int[Array, "h w"], Int[Array, "h w"]]:
    """Return the predicted classes and the truth, both `UNLABELLED` in cells that are empty or out of view. A cell is
    predicted by the mean probability over the image and its mirror image, if it reaches `min_confidence`. The network
    is equivariant to rotations of the scan but not to reflections, so only the mirror image adds more."""
    occupied = (counts > 0) & field_of_view(params.config)[0]
    logits = segment(params, jnp.stack([counts, counts[:, ::-1]]))
    upright, mirrored = jax.nn.softmax(logits[..., UNLABELLED + 1 :])  # without class 0, unlabelled
    probability = (upright + mirrored[:, ::-1]) / 2
    predicted = probability.argmax(-1).astype(jnp.int32) + UNLABELLED + 1
    is_confident = probability.max(-1) >= min_confidence
    return jnp.where(occupied & is_confident, predicted, UNLABELLED), jnp.where(occupied, truth, UNLABELLED)


def heat_maps(
    params: Params, bev: Num[Array | np.ndarray, "h w"], labels: Int[Array | np.ndarray, "h w"] | None = None
) -> Mapping[str, Float[np.ndarray, "h w"]]:
    """Compute the root mean square over the channels of feature maps, each scaled to the range from 0 to 1.

    The model selects the feature maps (`config.pictures`): those of its backbone, and the first of its place head.

    Arguments:
      params: Weights of the model.
      bev: One image of point counts.
      labels: Map of classes, if `describe` needs it.

    Returns:
      Maps by title, with NaN outside the field of view of the model.
    """
    strengths = jax.device_get(_strengths(params, jnp.asarray(bev), None if labels is None else jnp.asarray(labels)))
    maps = {}
    for title, name in params.config.pictures.items():
        above_minimum = strengths[name] - np.nanmin(strengths[name])
        maps[title] = above_minimum / max(np.nanmax(above_minimum), 1e-9)
    return maps


@jax.jit
def _strengths(
    params: Params, bev: Num[Array, "h w"], labels: Int[Array, "h w"] | None
) -> dict[str, Float[Array, "h w"]]:
    """Return strengths of the feature maps in `config.pictures` on the image's grid, NaN outside the field of view."""
    config, grid = params.config, params.config.grid
    outputs = forward(params, bev, labels, segment=0)

    def on_grid(features: Float[Array, "1 p q c"]) -> Float[Array, "h w"]:
        strength = jnp.sqrt(jnp.mean(features.astype(jnp.float32) ** 2, axis=-1, keepdims=True))
        if config.polar:
            grid_strength = from_polar(strength, grid)[0, ..., 0]
        else:
            grid_strength = jax.image.resize(strength[0, ..., 0], (grid.height, grid.width), "linear")
        return jnp.where(field_of_view(config)[0], grid_strength, jnp.nan)

    return {name: on_grid(outputs.intermediates[name]) for name in config.pictures.values()}
