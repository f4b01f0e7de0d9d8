"""Converts a record to the input of a model: its image and, if requested, its map of classes.

`view` converts one record. Training divides the work: the host computes `picture` or the points of each record, and the
compiled step applies `image_view` or `cloud_view` to a whole batch.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int, Int32, Num

from sglpr_jax.bev import (
    centre_crop,
    even_cells,
    rasterize,
    rasterize_labels,
    rotate_image,
    rotate_labels,
    rotate_points,
)
from sglpr_jax.data.density_image import check_density_counts, density_bev, density_label_bev
from sglpr_jax.data.scan import Scan, check_cloud
from sglpr_jax.grid import Grid, ImageKind, check_density_grid

_POINTS_STEP = 16384
"""Clouds are padded to a multiple of this number of points, so that few sizes are compiled."""


class View(NamedTuple):
    """Input of a model."""

    image: Float[Array | np.ndarray, "*b h w"]
    classes: Int[Array | np.ndarray, "*b h w"] | None = None
    """Class of every cell, 0 for empty and unlabelled cells. None if no classes were requested."""


def view(
    scan: Scan,
    grid: Grid | None,
    *,
    image: ImageKind = "points",
    categories: int = 0,
    angle: Float[Array | np.ndarray, ""] | None = None,
) -> View:
    """Compute the image (h, w) of a record on a grid and, if requested, its map of classes (h, w).

    Arguments:
      record: Scan or ready-made image.
      grid: Grid of the image. Ready-made images are cropped to it, or kept whole with None.
      image: Kind of image to compute from the points of a scan.
      categories: Number of classes of the map; 0 for no map.
      angle: Angle by which the place is rotated first, in radians, counter-clockwise.

    Raises ValueError if a scan shows no place (`check_cloud`), or if the grid, the kind or the labels do not fit.
    """
    classes = classes_of(scan, categories) if categories else None
    if scan.points is None:
        check_ready_made(scan, image)
        return image_view(*picture(scan, classes), grid, angle)
    check_cloud(scan.points, name=scan.name)
    if grid is None:
        raise ValueError("expected a grid for rasterising a scan, found none")
    if image == "density":
        check_density_grid(grid)
        points = scan.upright_points if angle is None else rotated(scan.upright_points, float(angle))
        return image_view(*picture(Scan(points=points), classes), grid)
    padding = -len(scan.points) % _POINTS_STEP
    points = jnp.asarray(np.pad(scan.upright_points, ((0, padding), (0, 0))))
    padded = None if classes is None else jnp.asarray(np.pad(classes, (0, padding)))
    return cloud_view(points, padded, jnp.int32(len(scan.points)), grid, angle)


def check_ready_made(scan: Scan, image: ImageKind) -> None:
    """Raise ValueError if a record has a ready-made image that is not of the given kind."""
    if image == "density" and scan.image is not None:
        check_density_counts(scan.image, name=scan.name)


def classes_of(scan: Scan, categories: int) -> Int32[np.ndarray, "..."]:
    """Return the class of every point or pixel. Raises ValueError if the record has no labels."""
    classes = scan.classes(categories)
    if classes is None:
        raise ValueError(f"{scan.name}: expected labels, found none")
    return classes


def picture(
    scan: Scan, classes: Int32[np.ndarray, "..."] | None
) -> tuple[Float32[np.ndarray, "h w"], Int32[np.ndarray, "h w"] | None]:
    """Return the whole ready-made image, or the whole density image of a scan, and its map of `classes`."""
    if scan.points is None:
        assert scan.image is not None
        return scan.image, classes
    points = scan.upright_points
    return density_bev(points), None if classes is None else density_label_bev(points, classes)


def image_view(
    image: Num[Array | np.ndarray, "*b h w"],
    classes: Int[Array | np.ndarray, "*b h w"] | None,
    grid: Grid | None,
    angle: Float[Array | np.ndarray, "*b"] | None = None,
) -> View:
    """Return the view of whole images and maps, rotated by `angle` and cropped to `grid`.

    With a grid, the wide central row and column of density images are split first (`even_cells`). With `grid=None`,
    images stay whole.
    """

    def see(whole: Any, rotate: Any) -> Array | np.ndarray:
        whole = whole if grid is None else even_cells(whole)
        whole = whole if angle is None else rotate(jnp.asarray(whole), angle)
        return whole if grid is None else centre_crop(whole, height=grid.height, width=grid.width)

    return View(see(image, rotate_image), None if classes is None else see(classes, rotate_labels))


def cloud_view(
    points: Float[Array | np.ndarray, "*b n 3"],
    classes: Int[Array | np.ndarray, "*b n"] | None,
    count: Int[Array | np.ndarray, "*b"],
    grid: Grid,
    angle: Float[Array | np.ndarray, "*b"] | None = None,
) -> View:
    """Return the view of padded clouds: a rotation by `angle` in radians, then rasterisation by eq. 1.

    `count` is the number of points of each cloud without padding.
    """
    points = points if angle is None else rotate_points(points, angle)
    counts = rasterize(points, grid=grid, count=count).astype(jnp.float32)
    return View(counts, None if classes is None else rasterize_labels(points, classes, grid=grid, count=count))


def rotated(points: Float32[np.ndarray, "n 3"], angle: float) -> Float32[np.ndarray, "n 3"]:
    """Return the result of `bev.rotate_points` without compiling for each number of points."""
    x, y, z = points.astype(np.float64).T
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1).astype(np.float32)
