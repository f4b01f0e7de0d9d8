"""3 x 3 convolution with a quarter of the multiplications: Winograd's minimal filtering F(4, 3) along both axes.

Six sums of six neighbouring pixels are multiplied by six sums of the kernel's three values. Four sums of these products
are four pixels of the result (Lavin and Gray 2016). If the rows have a stride, or if their number is not a multiple of
four, only the columns use this method, with half of the multiplications. The derivative needs equally few.
"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sglpr_jax.models.layers import product

AT_ONCE = 4
"""Number of output pixels along an axis from one set of products."""
BEYOND = 2
"""Number of pixels after the border that fill the last block of four."""
OF_PIXELS = np.array(
    [
        [4, 0, -5, 0, 1, 0],
        [0, -4, -4, 1, 1, 0],
        [0, 4, -4, -1, 1, 0],
        [0, -2, -1, 2, 1, 0],
        [0, 2, -1, -2, 1, 0],
        [0, 4, 0, -5, 0, 1],
    ],
    np.float32,
)
OF_KERNEL = np.array([[6, 0, 0], [-4, -4, -4], [-4, 4, -4], [1, 2, 4], [1, -2, 4], [0, 0, 24]], np.float32) / 24
OF_PRODUCTS = np.array([[1, 1, 1, 1, 1, 0], [0, 1, -1, 2, -2, 0], [0, 1, 1, 4, 4, 0], [0, 1, -1, 8, -8, 1]], np.float32)


def winograd(
    x: Float[Array, "b h w c"], kernel: Float[Array, "3 3 c f"], stride: int, circular: bool
) -> Float[Array, "b _ {x.shape[2]} f"]:
    """Convolve images with a border of one pixel. `stride` is along the rows; w must be a multiple of 4."""
    beside = (1, 1 + BEYOND)
    if circular:
        wide = jnp.concatenate([x[:, :, -1:], x, x[:, :, : 1 + BEYOND]], axis=2)
    else:
        wide = jnp.pad(x, ((0, 0), (0, 0), beside, (0, 0)))
    if stride > 1 or x.shape[1] % AT_ONCE:
        return _along_columns(wide, kernel, stride)
    return _along_both(jnp.pad(wide, ((0, 0), beside, (0, 0), (0, 0))), kernel)


def _along_both(x: Float[Array, "b h w c"], kernel: Float[Array, "3 3 c f"]) -> Float[Array, "b h-4 w-4 f"]:
    b, h, w, c = x.shape
    f = kernel.shape[-1]
    sums = _sums_of_kernel(np.kron(OF_KERNEL, OF_KERNEL), kernel).reshape(len(OF_KERNEL), -1, c, f)

    def along_columns(rows: Float[Array, "b m i"], kernels: Float[Array, "6 c f"]) -> Float[Array, "b m _"]:
        return four_at_once(rows.reshape(-1, w, c), _each(kernels), _of_pixels).reshape(*rows.shape[:2], -1)

    found = four_at_once(x.reshape(b, h, w * c), _each(sums), along_columns)
    return found.reshape(*found.shape[:2], -1, f)


def _along_columns(
    x: Float[Array, "b h w c"], kernel: Float[Array, "3 3 c f"], stride: int
) -> Float[Array, "b _ w-4 f"]:
    b, h, w, c = x.shape
    f = kernel.shape[-1]
    sums = _sums_of_kernel(OF_KERNEL, kernel.swapaxes(0, 1)).reshape(len(OF_KERNEL), 3 * c, f)

    def three_rows(columns: Float[Array, "n m c"], kernel: Float[Array, "3*c f"]) -> Float[Array, "_ m f"]:
        rows = jnp.pad(columns.reshape(b, h, -1), ((0, 0), (1, 1), (0, 0)))
        above = [jax.lax.slice_in_dim(rows, i, i + h, stride, axis=1).reshape(-1, c) for i in range(3)]
        return product(jnp.concatenate(above, axis=-1), kernel).reshape(-1, columns.shape[1], f)

    found = four_at_once(x.reshape(b * h, w, c), _each(sums), three_rows)
    return found.reshape(b, -1, *found.shape[1:])


def four_at_once(
    x: Float[Array, "a n i"], kernels: Sequence[Array], multiply: Callable[[Array, Array], Float[Array, "b m j"]]
) -> Float[Array, "b n-4 j"]:
    """Apply Winograd's filtering along the middle axis; n must be a multiple of 4.

    `multiply` applies one kernel along the other axes. The last two positions only fill a block, because the gradient
    of whole blocks is faster than that of slices.
    """
    a, n, i = x.shape
    blocks = x.reshape(a, n // AT_ONCE, AT_ONCE * i)
    sixes = [*jax.lax.split(blocks[:, :-1], [i] * AT_ONCE, 2), *jax.lax.split(blocks[:, 1:, : 2 * i], [i] * 2, 2)]
    products = [multiply(_weighted(by, sixes), of_one) for by, of_one in zip(OF_PIXELS, kernels, strict=True)]
    results = jnp.concatenate([_weighted(by, products) for by in OF_PRODUCTS], axis=-1)
    return results.reshape(len(results), n - AT_ONCE, -1)


def _of_pixels(x: Float[Array, "a m c"], matrix: Float[Array, "c f"]) -> Float[Array, "a m f"]:
    return product(x.reshape(-1, x.shape[-1]), matrix).reshape(*x.shape[:2], -1)


def _sums_of_kernel(by: Float[np.ndarray, "s k"], kernel: Float[Array, "3 3 c f"]) -> Float[Array, "s _"]:
    return jnp.matmul(by, kernel.reshape(by.shape[1], -1), precision=jax.lax.Precision.HIGHEST)


def _each(kernels: Float[Array, "n *dims"]) -> list[Float[Array, "*dims"]]:
    """Splits the kernels into separate arrays. The gradient of indexing would create zeros for each kernel."""
    return [of_one[0] for of_one in jax.lax.split(kernels, [1] * len(kernels), 0)]


def _weighted(weights: Float[np.ndarray, " n"], parts: Sequence[Array]) -> Array:
    """Weighted sum. Weights of 0 and 1 need no multiplication."""
    terms = [part if by == 1 else by * part for by, part in zip(weights, parts, strict=True) if by]
    return functools.reduce(jnp.add, terms)
