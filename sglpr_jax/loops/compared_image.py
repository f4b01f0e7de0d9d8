"""The part of a density image that is compared, and its preparation for the comparison."""

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

from sglpr_jax.bev import centre_crop
from sglpr_jax.loops.config import VerificationConfig

DEFAULT = VerificationConfig()
AnyArray = Array | np.ndarray


def within_reach(image: Num[AnyArray, "h w"], config: VerificationConfig = DEFAULT) -> Num[AnyArray, "m m"]:
    """Central part of an image that is compared. m is a multiple of two merged cells.

    Raises:
      ValueError: If the image is not square or has an odd number of cells.
    """
    if image.shape[0] != image.shape[1] or image.shape[0] % 2:
        raise ValueError(f"expected a square image of an even number of cells, found {image.shape}")
    size = min(2 * cells(config.reach_m, config.resolution_m), image.shape[0])
    size = max(size - size % (2 * config.coarse), 2 * config.coarse)
    return centre_crop(image, height=size, width=size)


def prepared(image: Num[AnyArray, "h w"], config: VerificationConfig) -> Float[Array, "m m"]:
    """Square root of the counts within reach. Other cells are zero. Raises the error of `within_reach`."""
    middle = within_reach(image, config)
    size = middle.shape[0]
    axis = (np.arange(size) - (size - 1) / 2) * config.resolution_m
    inside = np.hypot(axis[:, None], axis[None]) < min(config.reach_m, size / 2 * config.resolution_m)
    return jnp.where(inside, jnp.sqrt(jnp.maximum(jnp.asarray(middle, jnp.float32), 0)), 0)


def merged(image: Float[Array, "m m"], side: int) -> Float[Array, "k k"]:
    """Average pooling over squares of `side` cells."""
    size = image.shape[0] // side
    return image.reshape(size, side, size, side).mean((1, 3))


def occupied(image: Num[np.ndarray, "h w"], config: VerificationConfig = DEFAULT) -> float:
    """Number of occupied cells within reach."""
    return float(np.count_nonzero(image[_within(image.shape, config.reach_m / config.resolution_m)]))


@functools.cache
def _within(shape: tuple[int, int], radius: float) -> Bool[np.ndarray, "h w"]:
    """Whether each cell lies within a radius (in cells) of the centre."""
    down, right = (np.arange(n) - (n - 1) / 2 for n in shape)
    return np.hypot(down[:, None], right[None]) < radius


def cells(metres: float, cell_m: float) -> int:
    """Number of cells that cover a length, both in metres."""
    return int(np.ceil(metres / cell_m))
