"""Conversion of a scan to the input of a model: its image and, if requested, its map of classes.

`view` converts one scan. Training divides the work: the host computes `picture` or the points of each scan, and the
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
from sglpr_jax.data.density_image import density_bev, density_label_image
from sglpr_jax.data.scan import Scan, check_cloud
from sglpr_jax.grid import DENSITY_MAX_COUNT, Grid, ImageKind, check_density_grid

BEYOND_COUNTS = 2.0
"""Tolerance for counts below 0 or above 10, which smooth resizing of an image produces."""
_POINTS_STEP = 16384
"""Number of points to whose multiples clouds are padded, so that few sizes are compiled."""


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
    """Compute the image (h, w) of a scan on a grid and, if requested, its map of classes (h, w).

    Arguments:
      scan: Scan or ready-made image.
      grid: Grid of the image. Ready-made images are cropped to it, or kept whole with None.
      image: Kind of image to compute from the points of a scan.
      categories: Number of classes of the map; 0 for no map.
      angle: Angle by which the scan is rotated first, in radians, counter-clockwise.

    Raises ValueError if `check_cloud` rejects the points, or if the grid, the kind of image or the labels do not fit.
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
    padded_points = jnp.asarray(np.pad(scan.upright_points, ((0, padding), (0, 0))))
    padded_classes = None if classes is None else jnp.asarray(np.pad(classes, (0, padding)))
    return cloud_view(padded_points, padded_classes, jnp.int32(len(scan.points)), grid, angle)


def check_ready_made(scan: Scan, image: ImageKind) -> None:
    """Raise ValueError if a ready-made image should be a density image, but has floats outside 0 to 10."""
    if image != "density" or scan.image is None or not np.issubdtype(scan.image.dtype, np.floating):
        return
    least, most = scan.image.min(initial=0), scan.image.max(initial=0)
    if not (least >= -BEYOND_COUNTS and most <= DENSITY_MAX_COUNT + BEYOND_COUNTS):  # also for NaN
        raise ValueError(
            f"{scan.name}: expected a density image, floats from 0 to {DENSITY_MAX_COUNT}, found floats from "
            f"{least:g} to {most:g}; does the image contain grey values (255 instead of "
            f"{DENSITY_MAX_COUNT}) or uncapped point counts?"
        )


def classes_of(scan: Scan, categories: int) -> Int32[np.ndarray, "..."]:
    """Return the class of every point or pixel (`Scan.classes`). Raises ValueError if the scan has no labels."""
    classes = scan.classes(categories)
    if classes is None:
        raise ValueError(f"{scan.name}: expected labels, found none")
    return classes


def picture(
    scan: Scan, classes: Int32[np.ndarray, "..."] | None
) -> tuple[Float32[np.ndarray, "h w"], Int32[np.ndarray, "h w"] | None]:
    """Return the uncropped ready-made image, or density image of a scan, with its map of `classes`, if not None."""
    if scan.points is None:
        assert scan.image is not None
        return scan.image, classes
    points = scan.upright_points
    if classes is not None:
        classes = np.ascontiguousarray(np.rot90(density_label_image(points, classes), -1))
    return density_bev(points), classes


def image_view(
    image: Num[Array | np.ndarray, "*b h w"],
    classes: Int[Array | np.ndarray, "*b h w"] | None,
    grid: Grid | None,
    angle: Float[Array | np.ndarray, "*b"] | None = None,
) -> View:
    """Return the view of uncropped images and maps, rotated by `angle` in radians and cropped to `grid`.

    With a grid, the wide central row and column of density images are split first (`even_cells`). With `grid=None`,
    images are not cropped.
    """

    def rotate_and_crop(uncropped: Any, rotate: Any) -> Array | np.ndarray:
        if grid is not None:
            uncropped = even_cells(uncropped)
        rotated = uncropped if angle is None else rotate(jnp.asarray(uncropped), angle)
        return rotated if grid is None else centre_crop(rotated, height=grid.height, width=grid.width)

    classes = None if classes is None else rotate_and_crop(classes, rotate_labels)
    return View(rotate_and_crop(image, rotate_image), classes)


def cloud_view(
    points: Float[Array | np.ndarray, "*b n 3"],
    classes: Int[Array | np.ndarray, "*b n"] | None,
    count: Int[Array | np.ndarray, "*b"],
    grid: Grid,
    angle: Float[Array | np.ndarray, "*b"] | None = None,
) -> View:
    """Return the view of padded clouds: rotated by `angle` in radians, then rasterised by equation 1.

    `count` is the number of points of each cloud without padding.
    """
    points = points if angle is None else rotate_points(points, angle)
    counts = rasterize(points, grid=grid, count=count).astype(jnp.float32)
    return View(counts, None if classes is None else rasterize_labels(points, classes, grid=grid, count=count))


def rotated(points: Float32[np.ndarray, "n 3"], angle: float) -> Float32[np.ndarray, "n 3"]:
    """Rotate points about the z axis by `angle` radians, as `bev.rotate_points` but without compiling."""
    x, y, z = points.astype(np.float64).T
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1).astype(np.float32)
