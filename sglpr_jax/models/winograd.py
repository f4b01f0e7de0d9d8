"""A 3 x 3 convolution by half of the multiplications: Winograd's minimal filtering along the columns, F(4, 3).

Six sums of six neighbouring columns are multiplied with six sums of the kernel's three columns, and four sums of the
products are four columns of the result (Lavin and Gray 2016). Along the rows nothing changes, so that these may have a
stride. Its derivative needs as few multiplications.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sglpr_jax.models.layers import product

AT_ONCE = 4
"""Columns of the result from one set of products."""
OF_COLUMNS = np.array(
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


def four_columns_at_once(
    x: Float[Array, "b h w c"], kernel: Float[Array, "3 3 c f"], stride: int
) -> Float[Array, "b _ _ f"]:
    """The convolution of an image that has its border, one pixel each way; `stride` is along the rows.

    w - 2, the columns of the result, is a multiple of 4.
    """
    b, _, w, c = x.shape
    met = w - len(OF_COLUMNS) + 1
    columns = [jax.lax.slice_in_dim(x, j, j + met, AT_ONCE, axis=2) for j in range(len(OF_COLUMNS))]
    kernels = jnp.einsum("ij,rjcf->ircf", OF_KERNEL, kernel, precision=jax.lax.Precision.HIGHEST)
    products = []
    for weights, by in zip(OF_COLUMNS, kernels.reshape(len(OF_COLUMNS), 3 * c, -1), strict=True):
        rows = _three_rows(_weighted(weights, columns), stride)
        products.append(product(rows.reshape(-1, 3 * c), by))
    results = jnp.stack([_weighted(weights, products) for weights in OF_PRODUCTS], axis=1)
    return results.reshape(b, -1, w - 2, kernel.shape[-1])


def _weighted(weights: Float[np.ndarray, " n"], parts: Sequence[Array]) -> Array:
    """The weighted sum; weights of 0 and 1 cost nothing."""
    terms = [part if by == 1 else by * part for by, part in zip(weights, parts, strict=True) if by]
    return functools.reduce(jnp.add, terms)


def _three_rows(x: Float[Array, "b h w c"], stride: int) -> Float[Array, "b _ w 3*c"]:
    """Rows above each other, as channels."""
    met = x.shape[1] - 2
    return jnp.concatenate([jax.lax.slice_in_dim(x, i, i + met, stride, axis=1) for i in range(3)], axis=-1)
