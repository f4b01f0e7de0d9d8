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
"""Maximum kernel height times channels for which a matrix product is faster than XLA's convolution."""
RESULTS_PER_PATCH = 4
"""Number of neighbouring output columns that one patch gives if the kernel has few inputs."""


class Convolution(nn.Module):
    """Square convolution, padded by `size // 2` pixels on each side, or not if the strides equal the kernel size."""

    features: int
    size: int = 3
    """Edge of the kernel, in pixels."""
    strides: tuple[int, int] = (1, 1)
    """Strides along rows and columns."""
    circular: bool = False
    """Whether the columns wrap around, as in a polar image."""
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
    """Convolve padded images, with `strides` along rows and columns. The derivative is computed by matrix products."""
    if _has_few_inputs(kernel):
        return convolve_as_product(x, kernel, strides, circular)
    border = _border(kernel, strides)
    padding, axes = ((border, border), (0, 0)), ("NHWC", "HWIO", "NHWC")
    x = _pad_columns(x, border, circular)
    return jax.lax.conv_general_dilated(x, kernel, strides, padding, dimension_numbers=axes)


@convolve.defjvp
def _convolve_derivative(
    strides: tuple[int, int], circular: bool, primals: tuple[Array, Array], tangents: tuple[Array, Array]
):
    """Product rule of differentiation. Matrix products, unlike XLA's convolution, have fast gradients on a CPU."""
    (x, kernel), (x_tangent, kernel_tangent) = primals, tangents
    change_by_x = convolve_as_product(x_tangent, kernel, strides, circular)
    change_by_kernel = convolve_as_product(x, kernel_tangent, strides, circular)
    return convolve(x, kernel, strides, circular), change_by_x + change_by_kernel


def convolve_as_product(
    x: Float[Array, "b h w c"], kernel: Float[Array, "k k c f"], strides: tuple[int, int], circular: bool
) -> Float[Array, "b _ _ f"]:
    """Compute the same as `convolve` by one matrix product.

    With column stride 1, an odd kernel and many channels, the whole image is multiplied by every column of the kernel,
    and the k results are shifted and added. Otherwise `_multiply_patches` copies the k x k pixels under the kernel.
    """
    size, border = len(kernel), _border(kernel, strides)
    rows_padded = jnp.pad(x, ((0, 0), (border, border), (0, 0), (0, 0)))
    stacked_rows = stack_under_kernel(rows_padded, 1, size, strides[0])
    few_inputs = _has_few_inputs(kernel)
    if strides[1] == 1 and size % 2 == 1 and not few_inputs:
        matrix = kernel.swapaxes(1, 2).reshape(-1, size * kernel.shape[-1])  # (k * c, k * f)
        results = jnp.split(_multiply_channels(stacked_rows, matrix), size, axis=-1)
        return functools.reduce(jnp.add, [_shift(result, border - j, circular) for j, result in enumerate(results)])
    stacked_rows = _pad_columns(stacked_rows, border, circular)
    return _multiply_patches(stacked_rows, kernel, strides[1], RESULTS_PER_PATCH if few_inputs else 1)


def _multiply_patches(
    stacked_rows: Float[Array, "b h w _"], kernel: Float[Array, "k k c f"], stride: int, results_per_patch: int
) -> Float[Array, "b h _ f"]:
    """Convolve along the columns: cut the image into patches and multiply each by a matrix.

    The matrix holds the kernel at `results_per_patch` neighbouring positions, with zeros around it. Several positions
    pay for few channels, because memory access limits such a small product.
    """
    size, features = len(kernel), kernel.shape[-1]
    extra_columns = (results_per_patch - 1) * stride
    offsets = range(0, extra_columns + 1, stride)
    kernels = [jnp.pad(kernel, ((0, 0), (left, extra_columns - left), (0, 0), (0, 0))) for left in offsets]
    matrix = jnp.concatenate(kernels, axis=-1).swapaxes(0, 1).reshape(-1, results_per_patch * features)
    results = (stacked_rows.shape[2] - size) // stride + 1
    missing_columns = -results % results_per_patch * stride  # to complete the last patch
    padded = jnp.pad(stacked_rows, ((0, 0), (0, 0), (0, missing_columns), (0, 0)))
    patches = stack_under_kernel(padded, 2, size + extra_columns, results_per_patch * stride)
    y = _multiply_channels(patches, matrix)
    return y.reshape(*y.shape[:2], -1, features)[:, :, :results]


def _has_few_inputs(kernel: Float[Array, "k k c f"]) -> bool:
    return len(kernel) * kernel.shape[2] <= FEW_INPUTS


def _border(kernel: Float[Array, "k k c f"], strides: tuple[int, int]) -> int:
    """Return the padding on each side, in pixels: 0 if the stride equals the kernel size."""
    size = len(kernel)
    return 0 if strides == (size, size) else size // 2


def _pad_columns(x: Float[Array, "b h w c"], border: int, circular: bool) -> Float[Array, "b h _ c"]:
    """Add columns on the left and on the right: those of the opposite side, or zeros."""
    sides = ((0, 0), (0, 0), (border, border), (0, 0))
    return jnp.pad(x, sides, mode="wrap") if circular else jnp.pad(x, sides)


def stack_under_kernel(x: Float[Array, "b h w c"], axis: int, size: int, stride: int) -> Float[Array, "b _ _ _"]:
    """For each position of a kernel along `axis`, stack the `size` pixels that it covers as channels."""
    end = (x.shape[axis] - size) // stride * stride + 1
    return jnp.concatenate([jax.lax.slice_in_dim(x, i, i + end, stride, axis) for i in range(size)], axis=-1)


def _shift(x: Float[Array, "b h w c"], columns: int, circular: bool) -> Float[Array, "b h w c"]:
    """Shift an image to the right. Columns that leave the image enter on the other side, or zeros enter."""
    if circular:
        return jnp.roll(x, columns, axis=2)
    return jax.lax.pad(x, x.dtype.type(0), ((0, 0, 0), (0, 0, 0), (columns, -columns, 0), (0, 0, 0)))


def _multiply_channels(x: Float[Array, "b h w c"], matrix: Float[Array, "c f"]) -> Float[Array, "b h w f"]:
    """Multiply the channels of every pixel by a matrix."""
    return product(x.reshape(-1, x.shape[-1]), matrix).reshape(*x.shape[:3], -1)
