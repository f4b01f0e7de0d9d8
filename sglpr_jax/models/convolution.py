"""The convolution of the backbones and heads: XLA's going forward, products going backward.

Of few channels it is a product going forward too, and of many, on a CPU, Winograd's, of a quarter of the
multiplications.

On a CPU XLA computes the gradient of a kernel by a slow general loop where the step runs in chunks (27 to 70 times the
time of the products), and elsewhere it takes up to 1.8 times as long as they do.
"""

import functools
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models.layers import product, weight
from sglpr_jax.models.winograd import AT_ONCE as COLUMNS_AT_ONCE
from sglpr_jax.models.winograd import winograd

FEW_INPUTS = 16
"""Numbers of a column of pixels under the kernel up to which a product takes half the time of XLA's convolution."""
AT_ONCE = 4
"""Columns of the result that one row of such a product gives."""
MANY_CHANNELS = 32
"""Of the image and of the result: from here on sums of pixels cost less than the multiplications that they spare."""
MANY_PIXELS = 1536
"""Of all images together: below it sums of the kernel cost as much."""


class Convolution(nn.Module):
    """A square convolution, He-initialised; the columns of a `circular` image go around.

    Patches side by side (kernel = stride) need no border, others PyTorch's of kernel // 2.
    """

    features: int
    size: int = 3
    """Edge of the kernel."""
    strides: tuple[int, int] = (1, 1)
    """Along rows and columns."""
    circular: bool = False
    kernel_init: Callable = nn.initializers.he_normal()

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b _ _ {self.features}"]:
        """The last row or column counts as a whole stride where the stride does not divide them."""
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = jnp.asarray(weight(self, "kernel", self.kernel_init, shape), x.dtype)
        bias = weight(self, "bias", nn.initializers.zeros, (self.features,)).astype(x.dtype)
        y = convolve(x, kernel, self.strides, self.circular)
        return y + bias[None, None, None]


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def convolve(
    x: Float[Array, "b h w c"], kernel: Float[Array, "k k c f"], strides: tuple[int, int], circular: bool
) -> Float[Array, "b _ _ f"]:
    """XLA's convolution of the image with its border, or a product or more (`_as_products`) for few channels and many.

    Its derivative is that of the products.
    """
    if _few_inputs(kernel) or _saves_multiplications(x, kernel, strides):
        return _as_products(x, kernel, strides, circular)
    border = _border(kernel, strides)
    padding, axes = ((border, border), (0, 0)), ("NHWC", "HWIO", "NHWC")
    x = _columns_around(x, border, circular)
    return jax.lax.conv_general_dilated(x, kernel, strides, padding, dimension_numbers=axes)


@convolve.defjvp
def _(strides: tuple[int, int], circular: bool, primals: tuple[Array, Array], tangents: tuple[Array, Array]):
    (x, kernel), (x_tangent, kernel_tangent) = primals, tangents
    by_x = _as_products(x_tangent, kernel, strides, circular)
    return convolve(x, kernel, strides, circular), by_x + _as_products(x, kernel_tangent, strides, circular)


def _as_products(
    x: Float[Array, "b h w c"], kernel: Float[Array, "k k c f"], strides: tuple[int, int], circular: bool
) -> Float[Array, "b _ _ f"]:
    if not _saves_multiplications(x, kernel, strides):
        return as_product(x, kernel, strides, circular)
    return winograd(x, kernel, strides[0], circular)


def _saves_multiplications(
    x: Float[Array, "b h w c"], kernel: Float[Array, "k k c f"], strides: tuple[int, int]
) -> bool:
    """On a GPU cuDNN chooses for itself, and bfloat16 has no digits to spare for sums of pixels.

    An exported program, for any number of images and any machine, leaves it to XLA.
    """
    images, height, width, _ = x.shape
    suits = len(kernel) == 3 and strides[1] == 1 and width % COLUMNS_AT_ONCE == 0
    if not suits or min(kernel.shape[2:]) < MANY_CHANNELS or not isinstance(images, int):
        return False
    enough = images * height * width >= MANY_PIXELS
    return enough and x.dtype == jnp.float32 and jax.default_backend() == "cpu"


def as_product(
    x: Float[Array, "b h w c"], kernel: Float[Array, "k k c f"], strides: tuple[int, int], circular: bool
) -> Float[Array, "b _ _ f"]:
    """The same convolution as one matrix product.

    Where the stride leaves no column out, the product gives what each column adds to itself and to its neighbours, of
    the k pixels above each other; else it is of whole patches, k times the copies. Of few channels it is of patches
    wide enough for some results side by side, by a kernel that is mostly zeros: a product of so little is bound by
    what it reads and writes.
    """
    size, border, f = len(kernel), _border(kernel, strides), kernel.shape[-1]
    x = jnp.pad(x, ((0, 0), (border, border), (0, 0), (0, 0)))
    columns = _side_by_side(x, 1, size, strides[0])
    few = _few_inputs(kernel)
    if strides[1] == 1 and size % 2 and not few:
        added = jnp.split(_product(columns, kernel.swapaxes(1, 2).reshape(-1, size * f)), size, axis=-1)
        return functools.reduce(jnp.add, [_moved(of_one, border - j, circular) for j, of_one in enumerate(added)])
    columns, at_once = _columns_around(columns, border, circular), AT_ONCE if few else 1
    wide, stride = _side_by_side_kernels(kernel, at_once, strides[1]), at_once * strides[1]
    results = (columns.shape[2] - size) // strides[1] + 1
    lacking = -results % at_once * strides[1]
    patches = _side_by_side(jnp.pad(columns, ((0, 0), (0, 0), (0, lacking), (0, 0))), 2, wide.shape[1], stride)
    found = _product(patches, wide.swapaxes(0, 1).reshape(-1, at_once * f))
    return found.reshape(*found.shape[:2], -1, f)[:, :, :results]


def _few_inputs(kernel: Float[Array, "k k c f"]) -> bool:
    return len(kernel) * kernel.shape[2] <= FEW_INPUTS


def _side_by_side_kernels(kernel: Float[Array, "k k c f"], n: int, stride: int) -> Float[Array, "k _ c _"]:
    """One kernel that gives the results of n columns, each of which sees its own part of a wider patch."""
    beyond = (n - 1) * stride
    parts = [jnp.pad(kernel, ((0, 0), (j, beyond - j), (0, 0), (0, 0))) for j in range(0, beyond + 1, stride)]
    return jnp.concatenate(parts, axis=-1)


def _border(kernel: Float[Array, "k k c f"], strides: tuple[int, int]) -> int:
    """Patches side by side need none."""
    size = len(kernel)
    return 0 if strides == (size, size) else size // 2


def _columns_around(x: Float[Array, "b h w c"], border: int, circular: bool) -> Float[Array, "b h _ c"]:
    """Columns more at the left and the right: those of the other side, or zeros."""
    sides = ((0, 0), (0, 0), (border, border), (0, 0))
    return jnp.pad(x, sides, mode="wrap") if circular else jnp.pad(x, sides)


def _side_by_side(x: Float[Array, "b h w c"], axis: int, size: int, stride: int) -> Float[Array, "b _ _ _"]:
    """The pixels along the axis that the kernel meets at each place, as channels."""
    met = (x.shape[axis] - size) // stride * stride + 1
    return jnp.concatenate([jax.lax.slice_in_dim(x, i, i + met, stride, axis) for i in range(size)], axis=-1)


def _moved(x: Float[Array, "b h w c"], by: int, circular: bool) -> Float[Array, "b h w c"]:
    """Columns moved to the right; those that leave come in again, or zeros do."""
    if circular:
        return jnp.roll(x, by, axis=2)
    as_it_is = (0, 0, 0)
    return jax.lax.pad(x, x.dtype.type(0), (as_it_is, as_it_is, (by, -by, 0), as_it_is))


def _product(x: Float[Array, "b h w c"], matrix: Float[Array, "c f"]) -> Float[Array, "b h w f"]:
    return product(x.reshape(-1, x.shape[-1]), matrix).reshape(*x.shape[:3], -1)
