"""From a scan to its semantic map, by the head that training uses."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sglpr_jax.bev import rasterize, rasterize_labels
from sglpr_jax.labels import UNLABELLED
from sglpr_jax.models.sglpr import Params, field_of_view, segment

_POINTS_STEP = 16384
"""Clouds are padded to a multiple of this, so that few sizes are compiled."""


class SemanticMap(NamedTuple):
    """What a scan shows, cell by cell (h, w)."""

    counts: Int[np.ndarray, "h w"]
    predicted: Int[np.ndarray, "h w"]
    """Class ids; 0 where no point fell or the network does not look."""
    truth: Int[np.ndarray, "h w"]
    """The class of the last point; 0 in the same places, and where the scan has no label."""

    @property
    def seen(self) -> Bool[np.ndarray, "h w"]:
        """The cells that hold points and that the network looks at."""
        return self.predicted != UNLABELLED


def semantic_map(
    params: Params, points: Float[np.ndarray, "n 3"], classes: Int[np.ndarray, " n"] | None = None
) -> SemanticMap:
    """Predict the class of every cell that holds a point. `classes` are the points' true ones, if known."""
    padding = -len(points) % _POINTS_STEP
    classes = np.zeros(len(points), np.int32) if classes is None else classes
    padded = np.pad(points, ((0, padding), (0, 0))), np.pad(classes, (0, padding))
    return SemanticMap(*jax.device_get(_maps(params, *padded, jnp.int32(len(points)))))


@jax.jit
def _maps(
    params: Params, points: Float[Array, "n 3"], classes: Int[Array, " n"], count: Int[Array, ""]
) -> tuple[Int[Array, "h w"], Int[Array, "h w"], Int[Array, "h w"]]:
    grid = params.config.grid
    counts = rasterize(points, grid=grid, count=count)
    seen = (counts > 0) & field_of_view(params.config)[0]
    known = segment(params, counts)[..., UNLABELLED + 1 :]  # a cell with points in it is not "unlabelled"
    predicted = known.argmax(-1).astype(jnp.int32) + UNLABELLED + 1
    truth = rasterize_labels(points, classes, grid=grid, count=count)
    return counts, jnp.where(seen, predicted, UNLABELLED), jnp.where(seen, truth, UNLABELLED)
