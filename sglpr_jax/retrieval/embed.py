"""From scans or images to descriptors: any function of images, over a whole sequence."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sglpr_jax.bev import Grid, centre_crop, rasterize, rotate_image, rotate_points
from sglpr_jax.data.sequence import Drive, ImageSequence
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

DescribeFn = Callable[[Float[Array, "b h w"]], Float[Any, "b d"]]
"""Images of point counts in, one descriptor each out."""

_POINTS_STEP = 16384
"""Clouds are padded to a multiple of this, so that few sizes are compiled."""


def embed(
    describe: DescribeFn,
    sequence: Drive,
    grid: Grid | None,
    *,
    config: dict[str, Any],
    weights_hash: str = "",
    rotation_seed: int | None = None,
    batch: int = 16,
    on_bad_scan: Callable[[str, Exception], None] | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> DescriptorFile:
    """Describe every scan of a sequence.

    `grid` is the window to rasterise, or to cut ready-made images to; None leaves those whole. With `rotation_seed`
    every scan is first turned about z by its own random angle. A scan that cannot be read raises its error, or, given
    `on_bad_scan(id, error)`, is left out. `on_progress` is told how many scans are done.
    """
    angles = _angles(len(sequence), rotation_seed)
    rows, images, descriptors = [], [], []
    for row, image in _images(sequence, grid, angles, on_bad_scan):
        rows.append(row)
        images.append(image)
        if len(images) == batch:
            descriptors.append(_describe_padded(describe, images, batch))
            images = []
            on_progress(row + 1)
    if images:
        descriptors.append(_describe_padded(describe, images, batch))
    if not rows:
        raise ValueError(f"sequence {sequence.name}: expected at least one readable scan, found none")
    on_progress(len(sequence))
    return DescriptorFile(
        sequence=sequence.name,
        ids=tuple(sequence.ids[row] for row in rows),
        positions=None if sequence.positions is None else sequence.positions[rows],
        times=None if sequence.times is None else sequence.times[rows],
        descriptors=np.concatenate(descriptors),
        pose_source=sequence.pose_source,
        config={**config, "rotation_seed": rotation_seed},
        weights_hash=weights_hash,
    )


def _angles(n: int, seed: int | None) -> Float[np.ndarray, " n"] | None:
    return None if seed is None else np.random.default_rng(seed).uniform(0, 2 * np.pi, n)


def _images(
    sequence: Drive,
    grid: Grid | None,
    angles: Float[np.ndarray, " n"] | None,
    on_bad_scan: Callable[[str, Exception], None] | None,
) -> Iterator[tuple[int, Array]]:
    """Every readable scan's row and image."""
    for row in range(len(sequence)):
        angle = None if angles is None else jnp.float32(angles[row])
        try:
            yield row, read_image(sequence, row, grid, angle=angle)
        except (ValueError, OSError) as error:
            if on_bad_scan is None:
                raise
            on_bad_scan(sequence.ids[row], error)


def read_image(
    sequence: Drive, row: int, grid: Grid | None, *, angle: Float[Array, ""] | None = None
) -> Float[Array, "h w"]:
    """The image of one scan, turned by `angle` radians if given. Raises ValueError where scans come without a grid."""
    if isinstance(sequence, ImageSequence):
        image = jnp.asarray(sequence.image(row))
        image = image if angle is None else rotate_image(image, angle)
        return image if grid is None else centre_crop(image, height=grid.height, width=grid.width)
    if grid is None:
        raise ValueError("scans need a grid to be rasterised on, found none")
    points = sequence.points(row)
    count = jnp.int32(len(points))
    padding = -len(points) % _POINTS_STEP
    padded = jnp.asarray(np.pad(points, ((0, padding), (0, 0))))
    padded = padded if angle is None else rotate_points(padded, angle)
    return rasterize(padded, grid=grid, count=count).astype(jnp.float32)


def _describe_padded(describe: DescribeFn, images: list[Array], batch: int) -> Float[np.ndarray, "b d"]:
    """Describe up to `batch` images in a call of always the same shape, so that it compiles once."""
    stacked = jnp.stack(images + [images[-1]] * (batch - len(images)))
    return np.asarray(jax.block_until_ready(describe(stacked)), np.float32)[: len(images)]
