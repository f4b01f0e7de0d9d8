"""From an image of counts to what the network sees: rescaled, blank beyond the field of view, polar if asked for."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

from sglpr_jax.data.density_grid import MAX_COUNT
from sglpr_jax.grid import Grid
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.polar import to_polar

CLIP_COUNT = 10.0
FEWEST_CELLS = 2
"""An image shows a place from so many cells with points on. All empty images have one descriptor."""


def prepare(bev: Num[Array, "b h w"], config: ModelConfig) -> Float[Array, "b h w {config.channels}"]:
    """Point counts as network input: rescaled as `config.counts` says, blank where it does not see."""
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
    """The counts of an image. Those of a density image are fractions: bytes are its grey values, integers no image."""
    if config.image == "density" and not jnp.issubdtype(bev.dtype, jnp.floating):
        if bev.dtype != jnp.uint8:
            raise ValueError(
                "this model describes density images: expected counts 0 to 10 as floats, or grey values 0 to 255 as "
                f"uint8, found {bev.dtype}, which has lost the fractions of the counts"
            )
        return bev.astype(jnp.float32) * np.float32(MAX_COUNT / 255)
    return jnp.asarray(bev, jnp.float32)


def backbone_view(image: Float[Array, "b h w c"], config: ModelConfig) -> Float[Array, "b p q c"]:
    """An image as the backbone sees it: polar where the configuration says so, of the type that it computes in."""
    seen = to_polar(image, config.grid, *config.polar) if config.polar else image
    return seen.astype(config.compute)


def field_of_view(config: ModelConfig) -> Bool[np.ndarray, "1 h w"]:
    """Which cells the network sees: all, or those inside the largest circle, but not those of the vehicle itself."""
    grid, distance = config.grid, cell_distance(config.grid)
    seen = (distance < grid.resolution_m * min(grid.height, grid.width) / 2) | (config.field == "square")
    return (seen & (distance >= config.blind_m))[None]


def cell_distance(grid: Grid) -> Float[np.ndarray, "h w"]:
    """How far the middle of each cell lies from the sensor, metres."""
    down, right = np.mgrid[: grid.height, : grid.width]
    cells = np.hypot(down - (grid.height - 1) / 2, right - (grid.width - 1) / 2)
    return (grid.resolution_m * cells).astype(np.float32)
