"""Conversion of an image of counts to network input: scaling, field of view and, if configured, polar resampling."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

from sglpr_jax.data.density_grid import MAX_COUNT
from sglpr_jax.grid import Grid
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.polar import to_polar

CLIP_COUNT = 10.0
FEWEST_CELLS = 2
"""Minimum number of cells with points in an image that shows a place. All empty images have the same descriptor."""


def prepare(bev: Num[Array, "b h w"], config: ModelConfig) -> Float[Array, "b h w {config.channels}"]:
    """Convert point counts to network input.

    Counts are scaled as in `config.counts`, and cells outside the field of view are blank.
    """
    image = _counts(bev, config)
    if config.counts == "log1p":
        image = jnp.log1p(image)
    elif config.counts == "clipped":
        image = jnp.minimum(image, CLIP_COUNT) / CLIP_COUNT
    image = jnp.where(field_of_view(config), image, 0.0)[..., None]
    if config.range_channel:
        distance = cell_distance(config.grid) / cell_distance(config.grid).max()
        image = jnp.concatenate([image, jnp.broadcast_to(distance[None, ..., None], image.shape)], axis=-1)
    return image


def _counts(bev: Num[Array, "b h w"], config: ModelConfig) -> Float[Array, "b h w"]:
    """Counts of an image as float32. A density image has floats or uint8 grey values; other integers are invalid."""
    if config.image == "density" and not jnp.issubdtype(bev.dtype, jnp.floating):
        if bev.dtype != jnp.uint8:
            raise ValueError(
                "this model describes density images: expected counts 0 to 10 as floats, or grey values 0 to 255 as "
                f"uint8, found {bev.dtype}, which has lost the fractions of the counts"
            )
        return bev.astype(jnp.float32) * np.float32(MAX_COUNT / 255)
    return jnp.asarray(bev, jnp.float32)


def backbone_view(image: Float[Array, "b h w c"], config: ModelConfig) -> Float[Array, "b p q c"]:
    """Convert an image to the input of the backbone: polar if configured, and in the data type of the computation."""
    seen = to_polar(image, config.grid, *config.polar) if config.polar else image
    return seen.astype(config.compute)


def field_of_view(config: ModelConfig) -> Bool[np.ndarray, "1 h w"]:
    """Return the mask of cells that the network sees: within the field and at least `blind_m` from the sensor."""
    grid, distance = config.grid, cell_distance(config.grid)
    seen = (distance < grid.resolution_m * min(grid.height, grid.width) / 2) | (config.field == "square")
    return (seen & (distance >= config.blind_m))[None]


def cell_distance(grid: Grid) -> Float[np.ndarray, "h w"]:
    """Return the distance of each cell's centre from the sensor, in metres."""
    down, right = np.mgrid[: grid.height, : grid.width]
    cells = np.hypot(down - (grid.height - 1) / 2, right - (grid.width - 1) / 2)
    return (grid.resolution_m * cells).astype(np.float32)
