"""What a model sees of a raw scan: its image and, where it needs one, its map of classes."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int

from sglpr_jax.bev import Grid, ImageKind, centre_crop, even_cells, rasterize, rasterize_labels, rotate_points
from sglpr_jax.data.density_image import check_density_grid, density_bev, density_label_bev
from sglpr_jax.models.config import ModelConfig

_POINTS_STEP = 16384
"""Clouds are padded to a multiple of this, so that few sizes are compiled."""


def scan_image(points: Float32[np.ndarray, "n 3"], config: ModelConfig) -> Float32[Array, "h w"]:
    """The image of a scan (metres; x forward, y left, z up) that a model describes: see `ModelConfig.image`."""
    return scan_views(points, config.grid, image=config.image)[0]


def scan_views(
    points: Float32[np.ndarray, "n 3"],
    grid: Grid,
    *,
    image: ImageKind = "points",
    classes: Int[np.ndarray, " n"] | None = None,
    angle: Float[Array, ""] | None = None,
) -> tuple[Array, ...]:
    """The image (h, w) of a scan and, with the `classes` of its points, its map of classes (h, w).

    The points are turned by `angle` radians first, if given. Raises ValueError for a `grid` that has no density image.
    """
    if image == "density":
        return _density_views(points if angle is None else turned(points, float(angle)), grid, classes)
    count = jnp.int32(len(points))
    padding = -len(points) % _POINTS_STEP
    padded = jnp.asarray(np.pad(points, ((0, padding), (0, 0))))
    padded = padded if angle is None else rotate_points(padded, angle)
    counts = rasterize(padded, grid=grid, count=count).astype(jnp.float32)
    if classes is None:
        return (counts,)
    return counts, rasterize_labels(padded, jnp.asarray(np.pad(classes, (0, padding))), grid=grid, count=count)


def turned(points: Float32[np.ndarray, "n 3"], angle: float) -> Float32[np.ndarray, "n 3"]:
    """What `rotate_points` returns, without compiling for every number of points."""
    x, y, z = points.astype(np.float64).T
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1).astype(np.float32)


def _density_views(
    points: Float32[np.ndarray, "n 3"], grid: Grid, classes: Int[np.ndarray, " n"] | None
) -> tuple[Array, ...]:
    check_density_grid(grid)
    whole = [density_bev(points)] if classes is None else [density_bev(points), density_label_bev(points, classes)]
    cells = map(even_cells, map(jnp.asarray, whole))
    return tuple(centre_crop(view, height=grid.height, width=grid.width) for view in cells)
