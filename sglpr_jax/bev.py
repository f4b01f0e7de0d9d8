"""Bird's-eye-view images of point clouds (equation 1), and rotations about the vertical axis.

Points are in metres in the LiDAR frame: x forward, y left, z up. Images are `image[v, u]`: x increases with the column
u, and y decreases with the row v. Functions on point clouds accept any leading batch axes. For padded clouds, `count`
is the number of valid points.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Float, Int, Num, Shaped

from sglpr_jax.grid import Grid


def _cell_of_point(points: Float[Array, "*b n 3"], grid: Grid, count: Int[Array, "*b"] | None) -> Int[Array, "*b n"]:
    """Flat cell index of every point. Points outside, not finite or padding have the index after the last cell."""
    # XLA would compile a division by a constant to this multiplication and may set tiny values to zero. Do both always.
    scale = np.float32(1.0 / grid.resolution_m)
    planar = jnp.where(jnp.abs(points[..., :2]) < 1e-30, 0.0, points[..., :2])
    x, y = jnp.moveaxis(jnp.floor(planar * scale), -1, 0)
    is_valid = (x >= -grid.width // 2) & (x < grid.width // 2) & (y >= -grid.height // 2) & (y < grid.height // 2)
    is_valid &= jnp.isfinite(points).all(-1)
    if count is not None:
        row = jax.lax.broadcasted_iota(jnp.int32, is_valid.shape, is_valid.ndim - 1)
        is_valid &= row < count[..., None]
    u = grid.width // 2 + jnp.where(is_valid, x, 0).astype(jnp.int32)
    v = grid.height // 2 - jnp.where(is_valid, y, 0).astype(jnp.int32) - 1
    return jnp.where(is_valid, v * grid.width + u, grid.height * grid.width)


def _scatter(cells: Int[Array, "*b n"], values: Int[Array, "*b n"], grid: Grid, *, operation: str, start: int):
    """Return an image for each cloud, in which each cell is the "add" (sum) or the "max" of `start` and its values.

    `cells` has the flat cell index of each value, as from `_cell_of_point`.
    """
    cells_per_image = grid.height * grid.width + 1  # the last cell collects the values of invalid points
    batch_shape, points = cells.shape[:-1], cells.shape[-1]
    clouds = int(np.prod(batch_shape))
    first_cells = cells_per_image * jnp.arange(clouds, dtype=jnp.int32)[:, None]
    flat_images = jnp.full(clouds * cells_per_image, start, jnp.int32)
    scatter = getattr(flat_images.at[(cells.reshape(clouds, points) + first_cells).reshape(-1)], operation)
    images = scatter(values.reshape(-1)).reshape(*batch_shape, cells_per_image)
    return images[..., :-1].reshape(*batch_shape, grid.height, grid.width)


@functools.partial(jax.jit, static_argnames="grid")
def rasterize(
    points: Float[Array, "*b n 3"], *, grid: Grid, count: Int[Array, "*b"] | None = None
) -> Int[Array, "*b {grid.height} {grid.width}"]:
    """Count the points in each cell, as int32: the image B^I of equation 1.

    Points outside the window or not finite are dropped; `count_outside` counts them.

    Arguments:
      points: Point clouds in metres.
      grid: Cells of the image.
      count: Number of valid points at the front of each padded cloud. By default all points are valid.
    """
    cells = _cell_of_point(points, grid, count)
    return _scatter(cells, jnp.ones_like(cells), grid, operation="add", start=0)


@functools.partial(jax.jit, static_argnames="grid")
def rasterize_labels(
    points: Float[Array, "*b n 3"], labels: Int[Array, "*b n"], *, grid: Grid, count: Int[Array, "*b"] | None = None
) -> Int[Array, "*b {grid.height} {grid.width}"]:
    """Return the label of the last point in each cell, or 0 for empty cells: the map B^S of equation 1."""
    cells = _cell_of_point(points, grid, count)
    rows = jnp.broadcast_to(jnp.arange(points.shape[-2], dtype=jnp.int32), cells.shape)
    # Scattering the labels would keep any of several labels of a cell, so scatter the row of the last point.
    last_row = _scatter(cells, rows, grid, operation="max", start=-1)
    flat_rows = last_row.reshape(*last_row.shape[:-2], -1)
    last_label = jnp.take_along_axis(labels.astype(jnp.int32), flat_rows.clip(0), axis=-1)
    return jnp.where(last_row >= 0, last_label.reshape(last_row.shape), 0)


@functools.partial(jax.jit, static_argnames="grid")
def count_outside(
    points: Float[Array, "*b n 3"], *, grid: Grid, count: Int[Array, "*b"] | None = None
) -> Int[Array, "*b"]:
    """Count the valid points of each cloud that `rasterize` drops: those outside the window or not finite."""
    total = points.shape[-2] if count is None else count
    return total - rasterize(points, grid=grid, count=count).sum((-2, -1), dtype=jnp.int32)


@jax.jit
def rotate_points(points: Float[Array, "*b n 3"], angle: Float[Array, "*b"]) -> Float[Array, "*b n 3"]:
    """Rotate clouds about the z axis by `angle` radians, counter-clockwise seen from above."""
    x, y, z = jnp.moveaxis(points, -1, 0)
    cos, sin = jnp.cos(angle)[..., None], jnp.sin(angle)[..., None]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)


@jax.jit
def rotate_image(image: Float[Array, "*b h w"], angle: Float[Array, "*b"]) -> Float[Array, "*b h w"]:
    """Rotate images by `angle` radians as `rotate_points` rotates points: bilinear, with zeros beyond the border."""
    return _rotated(image, angle, order=1)


@jax.jit
def rotate_labels(labels: Int[Array, "*b h w"], angle: Float[Array, "*b"]) -> Int[Array, "*b h w"]:
    """Rotate class maps by `angle` radians as `rotate_image` rotates images, but with the class of the nearest cell."""
    return _rotated(labels, angle, order=0)


def _rotated(image: Shaped[Array, "*b h w"], angle: Float[Array, "*b"], *, order: int) -> Shaped[Array, "*b h w"]:
    """Rotate images about their centre by `angle`, in radians. Order 0 takes the nearest cell, order 1 interpolates."""
    *batch_shape, height, width = image.shape
    centre_v, centre_u = (height - 1) / 2, (width - 1) / 2
    v, u = np.mgrid[:height, :width].astype(np.float32)
    v, u = v - centre_v, u - centre_u

    def rotate(image, angle):
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        source = [cos * v + sin * u + centre_v, cos * u - sin * v + centre_u]
        return map_coordinates(image, source, order=order, mode="constant", cval=0)

    rotated = jax.vmap(rotate)(image.reshape(-1, height, width), jnp.reshape(angle, -1))
    return rotated.reshape(*batch_shape, height, width)


def even_cells(image: Num[Array | np.ndarray, "*b h w"]) -> Num[Array | np.ndarray, "*b h+h%2 w+w%2"]:
    """Split the wide middle row and column of a density image in two, so that all cells are those of equation 1.

    Density images have truncated coordinates, so the middle row and the middle column are as wide as two others. Each
    becomes two with half of the counts, or with the same labels (integers), so that the sensor is at the centre of an
    even crop. An axis with an even number of cells is unchanged.
    """
    # A JAX operation on a NumPy image would wait for the network that describes the previous batch.
    library: Any = np if isinstance(image, np.ndarray) else jnp
    has_counts = jnp.issubdtype(image.dtype, jnp.floating)
    for axis in (-2, -1):
        middle, remainder = divmod(image.shape[axis], 2)
        if remainder == 1:
            before, wide, after = library.split(image, (middle, middle + 1), axis=axis)
            half = wide / 2 if has_counts else wide
            image = library.concatenate([before, half, half, after], axis=axis)
    return image


def centre_crop(
    image: Shaped[Array | np.ndarray, "*b h w"], *, height: int, width: int
) -> Shaped[Array | np.ndarray, "*b {height} {width}"]:
    """Return the middle `height` x `width` cells of images. If a margin is odd, one more cell is cut after the crop.

    Raises ValueError if the images are smaller than the crop.
    """
    if image.shape[-2] < height or image.shape[-1] < width:
        raise ValueError(f"a crop of {height} x {width} cells requires a larger image, found {image.shape[-2:]}")
    first_row, _ = _margins(image.shape[-2], height)
    first_column, _ = _margins(image.shape[-1], width)
    return image[..., first_row : first_row + height, first_column : first_column + width]


def uncrop_labels(crop: Int[np.ndarray, "h w"], *, shape: tuple[int, ...]) -> Int[np.ndarray, "..."]:
    """Invert `even_cells` and `centre_crop`: return labels of a whole image of this shape, 0 outside the crop.

    If the two halves of a middle row or column differ, the first half counts, unless it is 0.
    """
    even_shape = [size + size % 2 for size in shape]
    labels = np.pad(crop, [_margins(size, part) for size, part in zip(even_shape, crop.shape, strict=True)])
    for axis, size in enumerate(shape):
        if size % 2:
            before, first, second, after = np.split(labels, np.arange(3) + size // 2, axis=axis)
            labels = np.concatenate([before, np.where(first, first, second), after], axis=axis)
    return labels


def _margins(cells: int, cropped_cells: int) -> tuple[int, int]:
    """Number of cells before and after a centred crop along one axis."""
    before = (cells - cropped_cells) // 2
    return before, cells - cropped_cells - before
