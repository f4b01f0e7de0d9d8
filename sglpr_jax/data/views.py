"""From a record to what a model sees of it: its image and, where asked for, its map of classes.

`view` does all of it for one record. Training takes the same road in two parts: `picture` or the points of a record on
the host, then `image_view` or `cloud_view` of a whole batch, inside its compiled step.
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
from sglpr_jax.data.degenerate import check_cloud
from sglpr_jax.data.density_grid import check_density_grid
from sglpr_jax.data.density_image import check_density_counts, density_bev, density_label_bev
from sglpr_jax.data.record import Record
from sglpr_jax.grid import Grid, ImageKind

_POINTS_STEP = 16384
"""Clouds are padded to a multiple of this, so that few sizes are compiled."""


class View(NamedTuple):
    """What a model sees."""

    image: Float[Array | np.ndarray, "*b h w"]
    classes: Int[Array | np.ndarray, "*b h w"] | None = None
    """The class of every cell, 0 where it is empty or not known; None where nobody asked."""


def view(
    record: Record,
    grid: Grid | None,
    *,
    image: ImageKind = "points",
    categories: int = 0,
    angle: Float[Array | np.ndarray, ""] | None = None,
) -> View:
    """The image (h, w) of a record on `grid` and, with `categories`, its map of so many classes (h, w).

    `image` says what the points of a scan are made into; a ready-made image is cut to the grid, or left whole with
    None. With `angle` (radians, counter-clockwise) the place is rotated first. Raises ValueError for a scan that shows
    no place (`check_cloud`) or has no grid, for a grid that has no density image, for a ready-made image that is none
    of densities where one is asked for, and for a record without the labels asked for.
    """
    classes = classes_of(record, categories) if categories else None
    if record.points is None:
        check_ready_made(record, image)
        return image_view(*picture(record, classes), grid, angle)
    check_cloud(record.points, name=record.name)
    if grid is None:
        raise ValueError("scans need a grid to be rasterised on, found none")
    if image == "density":
        check_density_grid(grid)
        points = record.upright_points if angle is None else rotated(record.upright_points, float(angle))
        return image_view(*picture(Record(points=points), classes), grid)
    padding = -len(record.points) % _POINTS_STEP
    points = jnp.asarray(np.pad(record.upright_points, ((0, padding), (0, 0))))
    padded = None if classes is None else jnp.asarray(np.pad(classes, (0, padding)))
    return cloud_view(points, padded, jnp.int32(len(record.points)), grid, angle)


def check_ready_made(record: Record, image: ImageKind) -> None:
    """Raise ValueError for a record with a ready-made image that cannot be of this kind."""
    if image == "density" and record.image is not None:
        check_density_counts(record.image, name=record.name)


def classes_of(record: Record, categories: int) -> Int32[np.ndarray, "..."]:
    """The class of every point or pixel; ValueError where the record has no labels."""
    classes = record.classes(categories)
    if classes is None:
        raise ValueError(f"{record.name}: expected labels, found none")
    return classes


def picture(
    record: Record, classes: Int32[np.ndarray, "..."] | None
) -> tuple[Float32[np.ndarray, "h w"], Int32[np.ndarray, "h w"] | None]:
    """A ready-made image, or the density image of a scan, whole; and the map of `classes` that lies on it."""
    if record.points is None:
        assert record.image is not None
        return record.image, classes
    points = record.upright_points
    return density_bev(points), None if classes is None else density_label_bev(points, classes)


def image_view(
    image: Num[Array | np.ndarray, "*b h w"],
    classes: Int[Array | np.ndarray, "*b h w"] | None,
    grid: Grid | None,
    angle: Float[Array | np.ndarray, "*b"] | None = None,
) -> View:
    """The view of whole images with their maps: on even cells, rotated by `angle`, cut to `grid` (None: left whole)."""

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
    """The view of padded clouds, `count` points of each, with the classes of their points: eq. 1 after a rotation."""
    points = points if angle is None else rotate_points(points, angle)
    counts = rasterize(points, grid=grid, count=count).astype(jnp.float32)
    return View(counts, None if classes is None else rasterize_labels(points, classes, grid=grid, count=count))


def rotated(points: Float32[np.ndarray, "n 3"], angle: float) -> Float32[np.ndarray, "n 3"]:
    """What `bev.rotate_points` returns, without compiling for every number of points."""
    x, y, z = points.astype(np.float64).T
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1).astype(np.float32)
