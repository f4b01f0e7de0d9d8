"""From a scan or a ready-made image to its semantic map, by the head that training uses."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from sglpr_jax.bev import centre_crop, even_cells
from sglpr_jax.data.sequence import Drive, ScanSequence
from sglpr_jax.labels import UNLABELLED, to_classes
from sglpr_jax.models.sglpr import Params, field_of_view, segment
from sglpr_jax.retrieval.scan_views import scan_views


class SemanticMap(NamedTuple):
    """What a scan shows, cell by cell (h, w)."""

    counts: Float[np.ndarray, "h w"]
    predicted: Int[np.ndarray, "h w"]
    """Class ids; 0 where no point fell, the network does not look or is not sure enough."""
    truth: Int[np.ndarray, "h w"]
    """The class of the last point; 0 in the same places, and where the scan has no label."""

    @property
    def seen(self) -> Bool[np.ndarray, "h w"]:
        """The cells that hold points and of which the network says something."""
        return self.predicted != UNLABELLED


def semantic_map(
    params: Params,
    points: Float32[np.ndarray, "n 3"],
    classes: Int[np.ndarray, " n"] | None = None,
    *,
    min_confidence: float = 0.0,
) -> SemanticMap:
    """Predict the class of every cell that holds a point. `classes` are the points' true ones, if known.

    Cells whose likeliest class is less probable than `min_confidence` are left unlabelled.
    """
    classes = np.zeros(len(points), np.int32) if classes is None else classes
    counts, truth = scan_views(points, params.config.grid, image=params.config.image, classes=classes)
    return _semantic_map(params, counts, truth, min_confidence)


def read_semantic_map(params: Params, sequence: Drive, row: int, *, min_confidence: float = 0.0) -> SemanticMap:
    """Read a scan or an image of a sequence, with its labels if it has any, and predict as `semantic_map` does.

    A ready-made image is cut to the model's grid, and its pixels above 0 are the cells that hold a point.
    """
    raw, grid = sequence.labels(row), params.config.grid
    classes = None if raw is None else to_classes(raw, categories=params.config.categories)
    if isinstance(sequence, ScanSequence):
        return semantic_map(params, sequence.points(row), classes, min_confidence=min_confidence)
    image = sequence.image(row)
    whole = image, np.zeros(image.shape, np.int32) if classes is None else classes
    counts, truth = (centre_crop(even_cells(jnp.asarray(x)), height=grid.height, width=grid.width) for x in whole)
    return _semantic_map(params, counts, truth, min_confidence)


def _semantic_map(params: Params, counts: Array, truth: Array, min_confidence: float) -> SemanticMap:
    return SemanticMap(*jax.device_get((counts, *_maps(params, counts, truth, jnp.float32(min_confidence)))))


@jax.jit
def _maps(
    params: Params, counts: Float[Array, "h w"], truth: Int[Array, "h w"], min_confidence: Float[Array, ""]
) -> tuple[Int[Array, "h w"], Int[Array, "h w"]]:
    seen = (counts > 0) & field_of_view(params.config)[0]
    known = segment(params, counts)[..., UNLABELLED + 1 :]  # a cell with points in it is not "unlabelled"
    predicted = known.argmax(-1).astype(jnp.int32) + UNLABELLED + 1
    sure = jax.nn.softmax(known).max(-1) >= min_confidence
    return jnp.where(seen & sure, predicted, UNLABELLED), jnp.where(seen, truth, UNLABELLED)
