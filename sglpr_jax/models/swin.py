"""Layers of the Swin-Unet: attention in windows, Swin blocks, and patches that merge or expand.

All arrays have 5 axes or fewer, so that `vmap` over a model stays within the limits of XLA's CPU backend.
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
"""Value added to the attention score of two tokens that must not see each other (`shift_mask`)."""


@cache
def relative_position_index(window: int) -> Int[np.ndarray, "t t"]:
    """Return for each (query, key) of a window the row of the bias table, which has a row for each offset (dy, dx)."""
    y, x = np.divmod(np.arange(window**2), window)
    dy_from_0 = y[:, None] - y[None, :] + window - 1
    dx_from_0 = x[:, None] - x[None, :] + window - 1
    return dy_from_0 * (2 * window - 1) + dx_from_0


@cache
def shift_mask(
    height: int, width: int, window: int, shift: tuple[int, int], *, circular: bool
) -> Bool[np.ndarray, "n t t"]:
    """Return True for token pairs that share a window only because the image was rolled by `-shift` (rows, columns).

    The roll moves the first rows and columns into the last windows. In a `circular` image the last columns are their
    true neighbours. The mask has n = (height / window) * (width / window) windows of t = window**2 tokens.
    """

    def region(size: int, size_of_shift: int) -> np.ndarray:
        """Return 2 for rows (columns) that were rolled in, 1 for others of the last window, 0 for other windows."""
        position = np.arange(size)
        return 1 * (position >= size - window) + (position >= size - size_of_shift)

    column_region = np.zeros(width, np.int64) if circular else region(width, shift[1])
    regions = 3 * region(height, shift[0])[:, None] + column_region[None, :]
    blocks = regions.reshape(height // window, window, width // window, window)
    tokens = blocks.transpose(0, 2, 1, 3).reshape(-1, window**2)
    return tokens[:, :, None] != tokens[:, None, :]


def split_windows(image: Float[Array, "b h w c"], window: int) -> Float[Array, "n t c"]:
    """Cut images into n = b * (h / window) * (w / window) windows, image by image, of t = window**2 tokens each."""
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
        """Attend within each of n windows. `blocked` is the `shift_mask` of the m windows of one image, or None."""
        n, t, c = windows.shape
        qkv = Linear(3 * c, name="qkv")(windows)
        q, k, v = (part.reshape(n, t, self.heads, -1) for part in jnp.split(qkv, 3, axis=-1))
        scaled_q = q * (c // self.heads) ** -0.5
        scores = jnp.einsum("nqhd,nkhd->nhqk", scaled_q, k, preferred_element_type=jnp.float32)
        scores = scores + self._position_bias(t)[None]
        if blocked is not None:
            mask = jnp.where(blocked, BLOCKED, 0.0)[None, :, None]
            scores = (scores.reshape(-1, len(blocked), self.heads, t, t) + mask).reshape(n, self.heads, t, t)
        mixed = jnp.einsum("nhqk,nkhd->nqhd", nn.softmax(scores).astype(v.dtype), v)
        return Linear(c, name="projection")(mixed.reshape(n, t, c))

    def _position_bias(self, tokens: int) -> Float[Array, "heads t t"]:
        """Return the bias of each (query, key), by a product with one-hot rows. The gradient of a lookup is slow."""
        window = round(tokens**0.5)
        rows = (2 * window - 1) ** 2
        table = weight(self, "position_bias", initial.normal(0.02), (rows, self.heads))
        one_hot = jax.nn.one_hot(relative_position_index(window).reshape(-1), rows)
        bias = jnp.matmul(one_hot, table, precision=jax.lax.Precision.HIGHEST)
        return bias.T.reshape(self.heads, tokens, tokens)


class PatchEmbed(nn.Module):
    """Make one token of each patch (rows, columns) of the image: a convolution with the patch as stride, then norm."""

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
    """Stochastic depth: in training, a random fraction `rate` of the branches becomes 0; the others are scaled up."""

    rate: float

    @nn.compact
    def __call__(self, branch: Float[Array, "b h w c"], *, train: bool) -> Float[Array, "b h w c"]:
        if not train or self.rate == 0:
            return branch
        kept_fraction = 1 - self.rate
        is_kept = jax.random.bernoulli(self.make_rng("drop_path"), kept_fraction, (len(branch), 1, 1, 1))
        return jnp.where(is_kept, branch / kept_fraction, 0.0)


class SwinBlock(nn.Module):
    """x + attention(norm(x)), then x + mlp(norm(x)). A map smaller than the window has windows of its shorter side."""

    heads: int
    window: int
    """Edge of a window, in tokens."""
    shifted: bool
    """Whether the windows are shifted by half a window. A direction that one window spans is not shifted."""
    mlp_ratio: int = 4
    """Hidden units per channel."""
    drop_path: float = 0.0
    circular: bool = False
    """Whether the first and the last column of the map are neighbours."""
    shift_each_way: bool = False
    """Whether a map that a window spans in one direction is still shifted in the other, unlike in Swin."""

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"], *, train: bool = False) -> Float[Array, "b h w c"]:
        """Return a map of the same shape, with `DropPath` if `train`. Raises ValueError if windows do not tile it."""
        attended = self._attend(LayerNorm(name="attention_norm")(x))
        x = x + DropPath(self.drop_path)(attended, train=train)
        hidden = gelu(Linear(self.mlp_ratio * x.shape[-1], name="mlp_in")(LayerNorm(name="mlp_norm")(x)))
        return x + DropPath(self.drop_path)(Linear(x.shape[-1], name="mlp_out")(hidden), train=train)

    def _attend(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        _, h, w, _ = x.shape
        window = min(self.window, h, w)
        if h % window or w % window:
            raise ValueError(f"windows of {window} x {window} tokens must tile the map, found {h} x {w} tokens")
        attention = WindowAttention(self.heads, name="attention")
        is_shifted = self.shifted and (min(h, w) > self.window or self.shift_each_way)
        row_shift = window // 2 if is_shifted and h > window else 0
        column_shift = window // 2 if is_shifted and w > window else 0
        if row_shift == column_shift == 0:
            return join_windows(attention(split_windows(x, window)), h, w)
        windows = split_windows(jnp.roll(x, (-row_shift, -column_shift), (1, 2)), window)
        mixed = attention(windows, shift_mask(h, w, window, (row_shift, column_shift), circular=self.circular))
        return jnp.roll(join_windows(mixed, h, w), (row_shift, column_shift), (1, 2))


class SwinStage(nn.Module):
    """Swin blocks at one resolution. Every second one has shifted windows."""

    heads: int
    drop_paths: tuple[float, ...]
    """Rate of stochastic depth of each block."""
    window: int
    mlp_ratio: int
    circular: bool = False
    shift_each_way: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"], *, train: bool = False) -> list[Float[Array, "b h w c"]]:
        """Returns the outputs of all blocks. The last one is the output of the stage."""
        outputs = []
        for i, rate in enumerate(self.drop_paths):
            block = SwinBlock(
                self.heads,
                self.window,
                shifted=i % 2 == 1,
                mlp_ratio=self.mlp_ratio,
                drop_path=rate,
                circular=self.circular,
                shift_each_way=self.shift_each_way,
                name=f"block_{i}",
            )
            x = block(x, train=train)
            outputs.append(x)
        return outputs


class PatchMerging(nn.Module):
    """Joins 2 x 2 tokens, in the order (y, x) = (0, 0), (1, 0), (0, 1), (1, 1), then norm, then a linear layer."""

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h//2 w//2 2*c"]:
        b, h, w, c = x.shape
        quads = x.reshape(b * h // 2, 2, w // 2, 2, c).transpose(0, 2, 3, 1, 4)
        quads = quads.reshape(b, h // 2, w // 2, 4 * c)
        return Linear(2 * c, use_bias=False, name="reduction")(LayerNorm(name="norm")(quads))


class PatchExpand(nn.Module):
    """Expands each token to factor x factor tokens by a linear layer with outputs (row, column, channel), then norm."""

    factor: int
    channels: int

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b _ _ {self.channels}"]:
        b, h, w, _ = x.shape
        tokens = Linear(self.factor**2 * self.channels, use_bias=False, name="expand")(x)
        strips = tokens.reshape(b * h, w, self.factor, self.factor * self.channels).transpose(0, 2, 1, 3)
        return LayerNorm(name="norm")(strips.reshape(b, h * self.factor, w * self.factor, self.channels))
