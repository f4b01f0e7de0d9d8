"""From a scan to its semantic map, by the head that training uses."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from sglpr_jax.labels import UNLABELLED
from sglpr_jax.models.sglpr import Params, field_of_view, segment
from sglpr_jax.retrieval.scan_views import scan_views


class SemanticMap(NamedTuple):
    """What a scan shows, cell by cell (h, w)."""

    counts: Float[np.ndarray, "h w"]
    predicted: Int[np.ndarray, "h w"]
    """Class ids; 0 where no point fell or the network does not look."""
    truth: Int[np.ndarray, "h w"]
    """The class of the last point; 0 in the same places, and where the scan has no label."""

    @property
    def seen(self) -> Bool[np.ndarray, "h w"]:
        """The cells that hold points and that the network looks at."""
        return self.predicted != UNLABELLED


def semantic_map(
    params: Params, points: Float32[np.ndarray, "n 3"], classes: Int[np.ndarray, " n"] | None = None
) -> SemanticMap:
    """Predict the class of every cell that holds a point. `classes` are the points' true ones, if known."""
    classes = np.zeros(len(points), np.int32) if classes is None else classes
    counts, truth = scan_views(points, params.config.grid, image=params.config.image, classes=classes)
    return SemanticMap(*jax.device_get((counts, *_maps(params, counts, truth))))


@jax.jit
def _maps(
    params: Params, counts: Float[Array, "h w"], truth: Int[Array, "h w"]
) -> tuple[Int[Array, "h w"], Int[Array, "h w"]]:
    seen = (counts > 0) & field_of_view(params.config)[0]
    known = segment(params, counts)[..., UNLABELLED + 1 :]  # a cell with points in it is not "unlabelled"
    predicted = known.argmax(-1).astype(jnp.int32) + UNLABELLED + 1
    return jnp.where(seen, predicted, UNLABELLED), jnp.where(seen, truth, UNLABELLED)
