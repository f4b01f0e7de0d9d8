"""Random sectors without points, as behind a pole, a cabin or a rider beside the sensor."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from sglpr_jax.grid import Grid
from sglpr_jax.training.config import OcclusionConfig


def visible(key: Array, images: int, grid: Grid, config: OcclusionConfig) -> Bool[Array, "b h w"]:
    """Return the visible cells of each image. In a fraction of the images, a sector with random bearing is hidden.

    The width of the sector is uniform between 0 and `config.widest_deg`. The bearing of a cell is that of its centre,
    seen from the middle of the grid.
    """
    chosen_key, width_key, start_key = jax.random.split(key, 3)
    chosen = jax.random.bernoulli(chosen_key, config.share, (images,))
    width = jnp.where(chosen, jax.random.uniform(width_key, (images,), maxval=jnp.deg2rad(config.widest_deg)), 0.0)
    start = jax.random.uniform(start_key, (images,), maxval=2 * jnp.pi)
    x, y = jnp.meshgrid(jnp.arange(grid.height) + 0.5, jnp.arange(grid.width) + 0.5, indexing="ij")
    bearing = jnp.arctan2(y - grid.width / 2, x - grid.height / 2)
    return (bearing[None] - start[:, None, None]) % (2 * jnp.pi) >= width[:, None, None]
