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
    # Multiply, because XLA compiles a division by a constant to a multiplication, where tiny values become zero.
    scale = np.float32(1.0 / grid.resolution_m)
    planar = jnp.where(jnp.abs(points[..., :2]) < 1e-30, 0.0, points[..., :2])
    x, y = jnp.moveaxis(jnp.floor(planar * scale), -1, 0)
    inside = (x >= -grid.width // 2) & (x < grid.width // 2) & (y >= -grid.height // 2) & (y < grid.height // 2)
    inside &= jnp.isfinite(points).all(-1)
    if count is not None:
        inside &= jax.lax.broadcasted_iota(jnp.int32, inside.shape, inside.ndim - 1) < count[..., None]
    u = grid.width // 2 + jnp.where(inside, x, 0).astype(jnp.int32)
    v = grid.height // 2 - jnp.where(inside, y, 0).astype(jnp.int32) - 1
    return jnp.where(inside, v * grid.width + u, grid.height * grid.width)


def _scatter(cells: Int[Array, "*b n"], values: Int[Array, "*b n"], grid: Grid, *, operation: str, start: int):
    """One image for each cloud. Each cell is the sum or the maximum of its values."""
    cells_per_image = grid.height * grid.width + 1  # the last cell collects values outside
    batch, n = cells.shape[:-1], cells.shape[-1]
    clouds = int(np.prod(batch))
    offsets = cells_per_image * jnp.arange(clouds, dtype=jnp.int32)[:, None]
    flat = jnp.full(clouds * cells_per_image, start, jnp.int32)
    scatter = getattr(flat.at[(cells.reshape(clouds, n) + offsets).reshape(-1)], operation)
    images = scatter(values.reshape(-1)).reshape(*batch, cells_per_image)
    return images[..., :-1].reshape(*batch, grid.height, grid.width)


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
    points: Float[Array, "*b n 3"],
    labels: Int[Array, "*b n"],
    *,
    grid: Grid,
    count: Int[Array, "*b"] | None = None,
) -> Int[Array, "*b {grid.height} {grid.width}"]:
    """Return the label of the last point in each cell, or 0 for empty cells: the map B^S of equation 1."""
    cells = _cell_of_point(points, grid, count)
    order = jnp.broadcast_to(jnp.arange(points.shape[-2], dtype=jnp.int32), cells.shape)
    # Duplicate writes have an undefined order; a maximum is well defined.
    last = _scatter(cells, order, grid, operation="max", start=-1)
    label = jnp.take_along_axis(labels.astype(jnp.int32), last.reshape(*last.shape[:-2], -1).clip(0), axis=-1)
    return jnp.where(last >= 0, label.reshape(last.shape), 0)


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
    """Rotate images about their centre as `rotate_points` rotates points: bilinear, with zeros beyond the border."""
    return _rotated(image, angle, order=1)


@jax.jit
def rotate_labels(labels: Int[Array, "*b h w"], angle: Float[Array, "*b"]) -> Int[Array, "*b h w"]:
    """Rotate class maps as `rotate_image` rotates images: each cell takes the class of the nearest cell."""
    return _rotated(labels, angle, order=0)


def _rotated(image: Shaped[Array, "*b h w"], angle: Float[Array, "*b"], *, order: int) -> Shaped[Array, "*b h w"]:
    """Rotate images about their centre by `angle`, in radians. Order 0 takes the nearest cell, order 1 interpolates."""
    *batch, height, width = image.shape
    down, right = np.mgrid[:height, :width].astype(np.float32)
    down, right = down - (height - 1) / 2, right - (width - 1) / 2

    def rotate(image, angle):
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        source_down, source_right = cos * down + sin * right, cos * right - sin * down
        source = [source_down + (height - 1) / 2, source_right + (width - 1) / 2]
        return map_coordinates(image, source, order=order, mode="constant", cval=0)

    rotated = jax.vmap(rotate)(image.reshape(-1, height, width), jnp.reshape(angle, -1))
    return rotated.reshape(*batch, height, width)


def even_cells(image: Num[Array | np.ndarray, "*b h w"]) -> Num[Array | np.ndarray, "*b h+h%2 w+w%2"]:
    """Convert a ready-made density image to the cells of equation 1, by halving its middle row and column.

    Ready-made images have truncated coordinates, so the middle row and the middle column are as wide as two others.
    Each becomes two with half of the counts, so that the sensor is at the centre of an even crop. Labels (integers) are
    not halved. Images with an even number of cells are unchanged.
    """
    # A JAX operation on a numpy image would wait for the network that describes the previous batch.
    library: Any = np if isinstance(image, np.ndarray) else jnp
    counts = jnp.issubdtype(image.dtype, jnp.floating)
    for axis in (-2, -1):
        middle, odd = divmod(image.shape[axis], 2)
        if odd:
            before, wide, after = library.split(image, (middle, middle + 1), axis=axis)
            half = wide / 2 if counts else wide
            image = library.concatenate([before, half, half, after], axis=axis)
    return image


def centre_crop(
    image: Shaped[Array | np.ndarray, "*b h w"], *, height: int, width: int
) -> Shaped[Array | np.ndarray, "*b {height} {width}"]:
    """Return the middle `height` x `width` cells of larger images. Of an odd margin, the far side loses one more cell.

    Raises ValueError if the image is smaller than the crop.
    """
    if image.shape[-2] < height or image.shape[-1] < width:
        raise ValueError(f"a crop of {height} x {width} cells requires a larger image, found {image.shape[-2:]}")
    down, right = _margin(image.shape[-2], height), _margin(image.shape[-1], width)
    return image[..., down[0] : down[0] + height, right[0] : right[0] + width]


def uncropped(crop: Int[np.ndarray, "h w"], *, shape: tuple[int, ...]) -> Int[np.ndarray, "..."]:
    """Return labels for a whole image of a `shape` from the labels of a crop of its `even_cells`, 0 outside the crop.

    If the two halves of a middle cell differ, the first half counts, unless it is 0.
    """
    whole = np.pad(crop, [_margin(size + size % 2, part) for size, part in zip(shape, crop.shape, strict=True)])
    for axis, size in enumerate(shape):
        if size % 2:
            before, first, second, after = np.split(whole, np.arange(3) + size // 2, axis=axis)
            whole = np.concatenate([before, np.where(first, first, second), after], axis=axis)
    return whole


def _margin(whole: int, part: int) -> tuple[int, int]:
    """Number of cells before and after a crop."""
    before = (whole - part) // 2
    return before, whole - part - before
