"""Convolution of the backbones and heads: XLA's in the forward pass, matrix products in the backward pass.

On a CPU, XLA's gradient of a kernel takes up to 1.8 times as long as the products, and 27 to 70 times as long if the
step runs in chunks. Convolutions with few input channels are one matrix product in the forward pass, too.
"""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models import initial
from sglpr_jax.models.initial import Initializer
from sglpr_jax.models.layers import product, weight

FEW_INPUTS = 16
"""Maximum kernel height times channels for which a matrix product takes half the time of XLA's convolution."""
RESULTS_PER_PATCH = 4
"""Number of output columns in one row of the matrix product for few channels."""


class Convolution(nn.Module):
    """Square convolution with He initialisation. With `circular=True` the columns wrap around.

    Images are padded by kernel // 2 pixels on each side, as in PyTorch. If the stride equals the kernel size, they are
    not padded.
    """

    features: int
    size: int = 3
    """Edge of the kernel, in pixels."""
    strides: tuple[int, int] = (1, 1)
    """Strides along rows and columns."""
    circular: bool = False
    kernel_init: Initializer = initial.he_normal
    use_bias: bool = True

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b _ _ {self.features}"]:
        """Convolve images. With padding, an odd kernel gives ceil(size / stride) rows and columns."""
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = jnp.asarray(weight(self, "kernel", self.kernel_init, shape), x.dtype)
        y = convolve(x, kernel, self.strides, self.circular)
        if not self.use_bias:
            return y
        return y + weight(self, "bias", initial.zeros, (self.features,)).astype(x.dtype)[None, None, None]


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def convolve(
    x: Float[Array, "b h w c"], kernel: Float[Array, "k k c f"], strides: tuple[int, int], circular: bool
) -> Float[Array, "b _ _ f"]:
    """Convolve padded images. The derivative is computed by matrix products.

    Convolutions with few input channels are computed by `as_product`, all others by XLA.
    """
    if _few_inputs(kernel):
        return as_product(x, kernel, strides, circular)
    border = _border(kernel, strides)
    padding, axes = ((border, border), (0, 0)), ("NHWC", "HWIO", "NHWC")
    x = _pad_columns(x, border, circular)
    return jax.lax.conv_general_dilated(x, kernel, strides, padding, dimension_numbers=axes)


@convolve.defjvp
def _(strides: tuple[int, int], circular: bool, primals: tuple[Array, Array], tangents: tuple[Array, Array]):
    (x, kernel), (x_tangent, kernel_tangent) = primals, tangents
    by_x = as_product(x_tangent, kernel, strides, circular)
    return convolve(x, kernel, strides, circular), by_x + as_product(x, kernel_tangent, strides, circular)


def as_product(
    x: Float[Array, "b h w c"], kernel: Float[Array, "k k c f"], strides: tuple[int, int], circular: bool
) -> Float[Array, "b _ _ f"]:
    """Compute the same convolution as one matrix product.

    With column stride 1 and an odd kernel, the product gives the contributions of each column, of k pixels above each
    other, to itself and to its neighbours. Otherwise it multiplies whole patches, which copies k times the data. For
    few channels, the patches are wide enough for several results side by side, and the kernel is mostly zeros: memory
    access limits this small product.
    """
    size, border, f = len(kernel), _border(kernel, strides), kernel.shape[-1]
    x = jnp.pad(x, ((0, 0), (border, border), (0, 0), (0, 0)))
    columns = _side_by_side(x, 1, size, strides[0])
    few = _few_inputs(kernel)
    if strides[1] == 1 and size % 2 and not few:
        parts = jnp.split(_product(columns, kernel.swapaxes(1, 2).reshape(-1, size * f)), size, axis=-1)
        return functools.reduce(jnp.add, [_shift(part, border - j, circular) for j, part in enumerate(parts)])
    columns, results_per_patch = _pad_columns(columns, border, circular), RESULTS_PER_PATCH if few else 1
    stride = results_per_patch * strides[1]
    beyond = stride - strides[1]
    kernels = [jnp.pad(kernel, ((0, 0), (j, beyond - j), (0, 0), (0, 0))) for j in range(0, beyond + 1, strides[1])]
    wide_kernel = jnp.concatenate(kernels, axis=-1)
    results = (columns.shape[2] - size) // strides[1] + 1
    missing = -results % results_per_patch * strides[1]
    columns = jnp.pad(columns, ((0, 0), (0, 0), (0, missing), (0, 0)))
    patches = _side_by_side(columns, 2, wide_kernel.shape[1], stride)
    y = _product(patches, wide_kernel.swapaxes(0, 1).reshape(-1, results_per_patch * f))
    return y.reshape(*y.shape[:2], -1, f)[:, :, :results]


def _few_inputs(kernel: Float[Array, "k k c f"]) -> bool:
    return len(kernel) * kernel.shape[2] <= FEW_INPUTS


def _border(kernel: Float[Array, "k k c f"], strides: tuple[int, int]) -> int:
    """Return the padding on each side, in pixels: 0 if the stride equals the kernel size."""
    size = len(kernel)
    return 0 if strides == (size, size) else size // 2


def _pad_columns(x: Float[Array, "b h w c"], border: int, circular: bool) -> Float[Array, "b h _ c"]:
    """Add columns on the left and on the right: those of the opposite side, or zeros."""
    sides = ((0, 0), (0, 0), (border, border), (0, 0))
    return jnp.pad(x, sides, mode="wrap") if circular else jnp.pad(x, sides)


def _side_by_side(x: Float[Array, "b h w c"], axis: int, size: int, stride: int) -> Float[Array, "b _ _ _"]:
    """Stack the pixels along the axis that the kernel covers at each position, as channels."""
    end = (x.shape[axis] - size) // stride * stride + 1
    return jnp.concatenate([jax.lax.slice_in_dim(x, i, i + end, stride, axis) for i in range(size)], axis=-1)


def _shift(x: Float[Array, "b h w c"], columns: int, circular: bool) -> Float[Array, "b h w c"]:
    """Shift an image to the right. Columns that leave the image enter on the other side, or zeros enter."""
    if circular:
        return jnp.roll(x, columns, axis=2)
    return jax.lax.pad(x, x.dtype.type(0), ((0, 0, 0), (0, 0, 0), (columns, -columns, 0), (0, 0, 0)))


def _product(x: Float[Array, "b h w c"], matrix: Float[Array, "c f"]) -> Float[Array, "b h w f"]:
    return product(x.reshape(-1, x.shape[-1]), matrix).reshape(*x.shape[:3], -1)
