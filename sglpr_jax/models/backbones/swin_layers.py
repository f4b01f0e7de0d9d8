"""Layers of a Swin transformer: patch embedding, blocks of window attention, patch merging and patch expansion."""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.backbones.attention import WindowAttention, join_windows, shift_mask, split_windows
from sglpr_jax.models.initial import torch_uniform, uniform
from sglpr_jax.models.layers import LayerNorm, Linear, gelu, weight

MLP_RATIO = 4
"""Hidden units of a block's MLP per channel, in the paper."""


class PatchEmbed(nn.Module):
    """One token for each patch of the image: a convolution with stride equal to its kernel, then layer norm."""

    channels: int
    patch: tuple[int, int] = (4, 4)
    """Rows and columns of a patch."""

    @nn.compact
    def __call__(
        self, image: Float[Array, "b h w c"]
    ) -> Float[Array, "b h//{self.patch[0]} w//{self.patch[1]} {self.channels}"]:
        """Maps `c` input channels to `channels` and divides height and width by those of the patch."""
        return LayerNorm(name="norm")(PatchProjection(self.channels, self.patch, name="projection")(image))


class PatchProjection(nn.Module):
    """Linear map of each patch: a convolution with stride equal to its kernel, initialised as in PyTorch."""

    channels: int
    patch: tuple[int, int]

    @nn.compact
    def __call__(self, image: Float[Array, "b h w c"]) -> Float[Array, "b _ _ {self.channels}"]:
        """Maps `c` input channels to `channels` and divides height and width by those of the patch."""
        shape = (*self.patch, image.shape[-1], self.channels)
        kernel = jnp.asarray(weight(self, "kernel", torch_uniform, shape), image.dtype)
        bias = weight(self, "bias", uniform(math.prod(shape[:-1]) ** -0.5), (self.channels,)).astype(image.dtype)
        axes = ("NHWC", "HWIO", "NHWC")
        tokens = jax.lax.conv_general_dilated(image, kernel, self.patch, "VALID", dimension_numbers=axes)
        return tokens + bias[None, None, None]


class DropPath(nn.Module):
    """Stochastic depth: training drops a whole branch per sample and scales kept branches by 1 / (1 - rate).

    It draws from the random stream `drop_path`.
    """

    rate: float

    @nn.compact
    def __call__(self, branch: Float[Array, "b h w c"], *, train: bool) -> Float[Array, "b h w c"]:
        """Returns the branch unchanged if `train` is False or the rate is 0."""
        if not train or self.rate == 0:
            return branch
        keep = 1 - self.rate
        kept = jax.random.bernoulli(self.make_rng("drop_path"), keep, (len(branch), 1, 1, 1))
        return jnp.where(kept, branch / keep, 0.0)


class SwinBlock(nn.Module):
    """x + attention(norm(x)), then x + mlp(norm(x)). With `shifted`, the windows are shifted by half a window.

    An image no larger than the window is one window of its own size and is not shifted. With `circular`, the first and
    last columns of the image are neighbours. With `shift_each_way`, an image that a window spans in one direction only
    is still shifted in the other direction. Swin does not shift it.
    """

    heads: int
    window: int
    shifted: bool
    mlp_ratio: int = MLP_RATIO
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
        down, right = self._shift(h, w, window)
        attention = WindowAttention(self.heads, name="attention")
        if not (down or right):
            return join_windows(attention(split_windows(x, window)), h, w)
        windows = split_windows(jnp.roll(x, (-down, -right), (1, 2)), window)
        mixed = attention(windows, shift_mask(h, w, window, (down, right), circular=self.circular))
        return jnp.roll(join_windows(mixed, h, w), (down, right), (1, 2))

    def _shift(self, h: int, w: int, window: int) -> tuple[int, int]:
        """Numbers of rows and columns by which the image is rolled."""
        if not self.shifted or (min(h, w) <= self.window and not self.shift_each_way):
            return 0, 0
        return (window // 2 if h > window else 0), (window // 2 if w > window else 0)


class SwinStage(nn.Module):
    """Blocks at one resolution, every second one shifted. `drop_paths` has a rate for each block."""

    heads: int
    window: int
    mlp_ratio: int
    drop_paths: tuple[float, ...]
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
                i % 2 == 1,
                self.mlp_ratio,
                rate,
                self.circular,
                self.shift_each_way,
                name=f"block_{i}",
            )
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
    """Doubles height and width and halves the channels."""

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b 2*h 2*w c//2"]:
        """Expands each token to 2 x 2 tokens."""
        return _expand(x, factor=2, channels=x.shape[-1] // 2)


class FinalPatchExpand(nn.Module):
    """Expansion of patches to pixels."""

    patch: int = 4
    channels: int | None = None
    """Output channels. None: the channels of the input."""

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b {self.patch}*h {self.patch}*w _"]:
        """Expands each token to patch x patch pixels."""
        return _expand(x, factor=self.patch, channels=self.channels or x.shape[-1])


def _expand(x: Float[Array, "b h w c"], *, factor: int, channels: int) -> Float[Array, "b _ _ _"]:
    """Linear layer with outputs in the order (row offset, column offset, channel), then norm: layers of the caller."""
    b, h, w, _ = x.shape
    tokens = Linear(factor**2 * channels, use_bias=False, name="expand")(x)
    strips = tokens.reshape(b * h, w, factor, factor * channels).transpose(0, 2, 1, 3)
    return LayerNorm(name="norm")(strips.reshape(b, h * factor, w * factor, channels))
