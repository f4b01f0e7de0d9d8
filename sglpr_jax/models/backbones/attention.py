"""Attention inside windows of an image, with a learned bias for each relative position.

All arrays have rank 5 or less, so that `vmap` over a model stays within the limits of XLA's CPU backend.
"""

from functools import cache

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sglpr_jax.models import initial
from sglpr_jax.models.layers import Linear, weight

BLOCKED = -100.0
"""Value added to the score of two tokens that are neighbours only because the image was rolled."""


@cache
def relative_position_index(window: int) -> Int[np.ndarray, "t t"]:
    """Row of the bias table for each (query, key) of a window with t = window**2 tokens, row-major.

    index[p, q] = (yp - yq + window - 1) * (2 * window - 1) + (xp - xq + window - 1)
    """
    y, x = np.divmod(np.arange(window**2), window)
    dy = y[:, None] - y[None, :] + window - 1
    dx = x[:, None] - x[None, :] + window - 1
    return dy * (2 * window - 1) + dx


@cache
def shift_mask(
    height: int, width: int, window: int, shift: int | tuple[int, int], *, circular: bool = False
) -> Bool[np.ndarray, "n t t"]:
    """Mask of the token pairs that must not see each other in an image rolled by `-shift` (rows, columns).

    The roll brings opposite borders together in the last windows; n = (height / window) * (width / window). In a
    `circular` image the left and right borders are neighbours, so the mask blocks nothing across them.
    """
    down, right = (shift, shift) if isinstance(shift, int) else shift
    columns = np.zeros(width, np.int64) if circular else _strip(width, window, right)
    regions = 3 * _strip(height, window, down)[:, None] + columns[None, :]
    blocks = regions.reshape(height // window, window, width // window, window)
    tokens = blocks.transpose(0, 2, 1, 3).reshape(-1, window**2)
    return tokens[:, :, None] != tokens[:, None, :]


def _strip(size: int, window: int, shift: int) -> Int[np.ndarray, " size"]:
    """Label of each row or column: 0 in other windows, 1 in the last window's own part, 2 in its rolled-in part."""
    place = np.arange(size)
    return (place >= size - window).astype(np.int64) + (place >= size - shift)


def split_windows(image: Float[Array, "b h w c"], window: int) -> Float[Array, "n t c"]:
    """Cut images into windows: n = b * (h / window) * (w / window), images slowest; t = window**2, row-major."""
    b, h, w, c = image.shape
    strips = image.reshape(b * h // window, window, w // window, window * c)
    return strips.transpose(0, 2, 1, 3).reshape(-1, window**2, c)


def join_windows(windows: Float[Array, "n t c"], height: int, width: int) -> Float[Array, "b h w c"]:
    """Join windows to images of height x width: the inverse of `split_windows`."""
    _, tokens, c = windows.shape
    window = round(tokens**0.5)
    strips = windows.reshape(-1, width // window, window, window * c)
    return strips.transpose(0, 2, 1, 3).reshape(-1, height, width, c)


class WindowAttention(nn.Module):
    """Multi-head attention in each window: softmax(q k^T / sqrt(d) + bias + mask) v, then a linear layer."""

    heads: int

    @nn.compact
    def __call__(
        self, windows: Float[Array, "n t c"], blocked: Bool[np.ndarray, "m t t"] | None = None
    ) -> Float[Array, "n t c"]:
        """`blocked` is the shift mask for the m windows of one image; n must be a multiple of m."""
        n, t, c = windows.shape
        qkv = Linear(3 * c, name="qkv")(windows)
        q, k, v = (part.reshape(n, t, self.heads, -1) for part in jnp.split(qkv, 3, axis=-1))
        scaled = q * (c // self.heads) ** -0.5
        scores = jnp.einsum("nqhd,nkhd->nhqk", scaled, k, preferred_element_type=jnp.float32)
        scores = scores + self._position_bias(t)[None]
        if blocked is not None:
            mask = jnp.where(blocked, BLOCKED, 0.0)[None, :, None]
            scores = (scores.reshape(-1, len(blocked), self.heads, t, t) + mask).reshape(n, self.heads, t, t)
        mixed = jnp.einsum("nhqk,nkhd->nqhd", nn.softmax(scores).astype(v.dtype), v)
        return Linear(c, name="projection")(mixed.reshape(n, t, c))

    def _position_bias(self, tokens: int) -> Float[Array, "heads t t"]:
        """Looks up the table by a product with one-hot rows, whose gradient is a product instead of a slow scatter."""
        window = round(tokens**0.5)
        rows = (2 * window - 1) ** 2
        table = weight(self, "position_bias", initial.normal(0.02), (rows, self.heads))
        one_hot = jax.nn.one_hot(relative_position_index(window).reshape(-1), rows)
        bias = jnp.matmul(one_hot, table, precision=jax.lax.Precision.HIGHEST)
        return bias.T.reshape(self.heads, tokens, tokens)
