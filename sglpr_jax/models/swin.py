"""Attention inside windows of an image, with a learned bias for each relative position.

All arrays have rank 5 or less, so that `vmap` over a model stays within the limits of XLA's CPU backend.
"""

import math
from functools import cache

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sglpr_jax.models import initial
from sglpr_jax.models.initial import torch_uniform, uniform
from sglpr_jax.models.layers import LayerNorm, Linear, gelu, weight

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
    height: int, width: int, window: int, shift: tuple[int, int], *, circular: bool
) -> Bool[np.ndarray, "n t t"]:
    """Mask of the token pairs that must not see each other in an image rolled by `-shift` (rows, columns).

    The roll brings opposite borders together in the last windows; n = (height / window) * (width / window). In a
    `circular` image the left and right borders are neighbours, so the mask blocks nothing across them.
    """
    row, column = np.arange(height), np.arange(width)
    # Rows and columns are labelled 0 in other windows, 1 in the last window's own part, 2 in its rolled-in part.
    row = 1 * (row >= height - window) + (row >= height - shift[0])
    column = 0 * column if circular else 1 * (column >= width - window) + (column >= width - shift[1])
    regions = 3 * row[:, None] + column[None, :]
    blocks = regions.reshape(height // window, window, width // window, window)
    tokens = blocks.transpose(0, 2, 1, 3).reshape(-1, window**2)
    return tokens[:, :, None] != tokens[:, None, :]


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
        """Read the table by a product with one-hot rows, because the gradient of a lookup is a slow scatter."""
        window = round(tokens**0.5)
        rows = (2 * window - 1) ** 2
        table = weight(self, "position_bias", initial.normal(0.02), (rows, self.heads))
        one_hot = jax.nn.one_hot(relative_position_index(window).reshape(-1), rows)
        bias = jnp.matmul(one_hot, table, precision=jax.lax.Precision.HIGHEST)
        return bias.T.reshape(self.heads, tokens, tokens)


class PatchEmbed(nn.Module):
    """One token for each patch (rows, columns) of the image: a convolution with this stride, then layer norm."""

    channels: int
    patch: tuple[int, int]

    @nn.compact
    def __call__(
        self, image: Float[Array, "b h w c"]
    ) -> Float[Array, "b h//{self.patch[0]} w//{self.patch[1]} {self.channels}"]:
        return LayerNorm(name="norm")(PatchProjection(self.channels, self.patch, name="projection")(image))


class PatchProjection(nn.Module):
    """Convolution of `PatchEmbed`, initialised as in PyTorch."""

    channels: int
    patch: tuple[int, int]

    @nn.compact
    def __call__(self, image: Float[Array, "b h w c"]) -> Float[Array, "b _ _ {self.channels}"]:
        shape = (*self.patch, image.shape[-1], self.channels)
        kernel = jnp.asarray(weight(self, "kernel", torch_uniform, shape), image.dtype)
        bias = weight(self, "bias", uniform(math.prod(shape[:-1]) ** -0.5), (self.channels,)).astype(image.dtype)
        axes = ("NHWC", "HWIO", "NHWC")
        tokens = jax.lax.conv_general_dilated(image, kernel, self.patch, "VALID", dimension_numbers=axes)
        return tokens + bias[None, None, None]


class DropPath(nn.Module):
    """Stochastic depth: training drops the whole branch of some samples, by the random stream `drop_path`, and scales
    the other branches by 1 / (1 - rate)."""

    rate: float

    @nn.compact
    def __call__(self, branch: Float[Array, "b h w c"], *, train: bool) -> Float[Array, "b h w c"]:
        if not train or self.rate == 0:
            return branch
        share = 1 - self.rate
        is_kept = jax.random.bernoulli(self.make_rng("drop_path"), share, (len(branch), 1, 1, 1))
        return jnp.where(is_kept, branch / share, 0.0)


class SwinBlock(nn.Module):
    """x + attention(norm(x)), then x + mlp(norm(x)), with `mlp_ratio` hidden units per channel.

    With `shifted`, the windows are shifted by half a window. An image no larger than the window is one window of its
    own size and is not shifted. With `circular`, the first and last columns of the image are neighbours. With
    `shift_each_way`, an image that a window spans in one direction is still shifted in the other, unlike in Swin.
    """

    heads: int
    window: int
    shifted: bool
    mlp_ratio: int = 4
    drop_path: float = 0.0
    circular: bool = False
    shift_each_way: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"], *, train: bool = False) -> Float[Array, "b h w c"]:
        """Returns a map of the same shape. `train` enables stochastic depth.

        Raises:
          ValueError: If windows do not tile the map.
        """
        attended = self._attend(LayerNorm(name="attention_norm")(x))
        x = x + DropPath(self.drop_path)(attended, train=train)
        hidden = gelu(Linear(self.mlp_ratio * x.shape[-1], name="mlp_in")(LayerNorm(name="mlp_norm")(x)))
        return x + DropPath(self.drop_path)(Linear(x.shape[-1], name="mlp_out")(hidden), train=train)

    def _attend(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        _, h, w, _ = x.shape
        window = min(self.window, h, w)
        if h % window or w % window:
            raise ValueError(f"windows of {window} x {window} tokens must tile the map, found {h} x {w} tokens")
        shifted = self.shifted and (min(h, w) > self.window or self.shift_each_way)
        down, right = (shifted * window // 2 if size > window else 0 for size in (h, w))
        attention = WindowAttention(self.heads, name="attention")
        if not (down or right):
            return join_windows(attention(split_windows(x, window)), h, w)
        windows = split_windows(jnp.roll(x, (-down, -right), (1, 2)), window)
        mixed = attention(windows, shift_mask(h, w, window, (down, right), circular=self.circular))
        return jnp.roll(join_windows(mixed, h, w), (down, right), (1, 2))


class SwinStage(nn.Module):
    """Blocks at one resolution, every second one shifted. `drop_paths` has a rate for each block."""

    heads: int
    drop_paths: tuple[float, ...]
    window: int
    mlp_ratio: int
    circular: bool = False
    shift_each_way: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"], *, train: bool = False) -> list[Float[Array, "b h w c"]]:
        """Returns the outputs of all blocks. The last one is the output of the stage."""
        outputs = []
        for i, rate in enumerate(self.drop_paths):
            options = (self.window, i % 2 == 1, self.mlp_ratio, rate, self.circular, self.shift_each_way)
            block = SwinBlock(self.heads, *options, name=f"block_{i}")
            x = block(x, train=train)
            outputs.append(x)
        return outputs


class PatchMerging(nn.Module):
    """Halves height and width and doubles the channels."""

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h//2 w//2 2*c"]:
        """Joins 2 x 2 tokens in the order (y, x) = (0, 0), (1, 0), (0, 1), (1, 1), then norm, then a linear layer."""
        b, h, w, c = x.shape
        quads = x.reshape(b * h // 2, 2, w // 2, 2, c).transpose(0, 2, 3, 1, 4)
        quads = quads.reshape(b, h // 2, w // 2, 4 * c)
        return Linear(2 * c, use_bias=False, name="reduction")(LayerNorm(name="norm")(quads))


class PatchExpand(nn.Module):
    """Expands each token to factor x factor tokens or pixels: a linear layer with outputs in the order (row offset,
    column offset, channel), then norm."""

    factor: int
    channels: int

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b _ _ {self.channels}"]:
        b, h, w, _ = x.shape
        tokens = Linear(self.factor**2 * self.channels, use_bias=False, name="expand")(x)
        strips = tokens.reshape(b * h, w, self.factor, self.factor * self.channels).transpose(0, 2, 1, 3)
        return LayerNorm(name="norm")(strips.reshape(b, h * self.factor, w * self.factor, self.channels))
