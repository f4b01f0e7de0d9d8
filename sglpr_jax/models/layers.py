"""Layers that all networks share: linear layer, layer norm, maximum, NetVLAD's residuals and unit length.

Weights are float32. Layers multiply in the data type of their input. A network therefore computes in the type of its
image (`ModelConfig.compute`), except where a module requests float32.
"""

import functools
import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from sglpr_jax.models import initial
from sglpr_jax.models.initial import Initial, Initializer

EPSILON = 1e-5
"""PyTorch's epsilon of a layer norm."""
NORM_FLOOR = 1e-12
ROUNDING = 1e-6
"""Relative difference from the maximum below which an entry counts as equal to it."""


def weight(module: nn.Module, name: str, init: Initializer, shape: tuple[int, ...]) -> Any:
    """Return a weight of the calling module. At initialisation, create it and store its distribution for `draw_all`.

    Flax's `param` traces `init` in every call to find the shape. This takes half of the time of tracing a network.

    Raises:
      ValueError: If the weight has another shape.
    """
    if not module.has_variable("params", name):
        if module.is_initializing() and module.is_mutable_collection("initial"):
            module.put_variable("initial", name, init)
        return module.param(name, init, shape)
    value = module.get_variable("params", name)
    if value.shape != shape:
        raise ValueError(f"{'/'.join((*module.path, name))}: expected weights of shape {shape}, found {value.shape}")
    return value


class Linear(nn.Module):
    """Dense layer with weights N(0, 0.02) and bias 0, computed as one product of two matrices.

    XLA's CPU backend is three times slower if the leading axes are kept separate.
    """

    features: int
    use_bias: bool = True
    kernel_init: Initial = initial.normal(0.02)

    @nn.compact
    def __call__(self, x: Float[Array, "*b c"]) -> Float[Array, "*b {self.features}"]:
        c = x.shape[-1]
        kernel = weight(self, "kernel", self.kernel_init, (c, self.features)).astype(x.dtype)
        y = product(x.reshape(-1, c), jnp.asarray(kernel))
        if self.use_bias:
            y = y + weight(self, "bias", initial.zeros, (self.features,)).astype(x.dtype)[None]
        return y.reshape(*x.shape[:-1], self.features)


@jax.custom_jvp
def product(x: Float[Array, "n c"], matrix: Float[Array, "c f"]) -> Float[Array, "n f"]:
    """Multiply many rows by a matrix.

    For a matrix with more rows than columns, the derivative exchanges the factors of its sum over the rows, because
    XLA's CPU backend rearranges the first one. The barrier keeps XLA from exchanging them again.
    """
    return x @ matrix


@product.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]):
    (x, matrix), (x_tangent, matrix_tangent) = primals, tangents
    if len(x) > len(matrix) > matrix.shape[1]:
        transposed = jax.lax.optimization_barrier(matrix_tangent.T)
        by_matrix = jax.lax.dot_general(x, transposed, (((1,), (1,)), ((), ())))
    else:
        by_matrix = x @ matrix_tangent
    return product(x, matrix), x_tangent @ matrix + by_matrix


def gelu(x: Float[Array, "*dims"]) -> Float[Array, "*dims"]:
    """Exact GELU: x times the normal distribution function. It uses erf, `jax.nn.gelu` the slower erfc."""
    return 0.5 * x * (1 + jax.lax.erf(x * math.sqrt(0.5)))


class LayerNorm(nn.Module):
    """Layer norm over channels with the arithmetic of Flax, computed in float32."""

    @nn.compact
    def __call__(self, x: Float[Array, "*b c"]) -> Float[Array, "*b c"]:
        scale = jnp.asarray(weight(self, "scale", initial.ones, x.shape[-1:]))
        bias = jnp.asarray(weight(self, "bias", initial.zeros, x.shape[-1:]))
        rows = x.astype(jnp.float32).reshape(-1, x.shape[-1])
        return layer_norm(rows, scale, bias).astype(x.dtype).reshape(x.shape)


@jax.custom_jvp
def layer_norm(x: Float[Array, "n c"], scale: Float[Array, " c"], bias: Float[Array, " c"]) -> Float[Array, "n c"]:
    """Normalise every row. XLA passes over the rows more often for the derivative of JAX than for this one."""
    mean, per_deviation = _statistics(x)
    return (x - mean) * (per_deviation * scale[None]) + bias[None]


@layer_norm.defjvp
def _(primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]):
    (x, scale, bias), (x_tangent, scale_tangent, bias_tangent) = primals, tangents
    mean, per_deviation = _statistics(x)
    normed = (x - mean) * per_deviation
    along = x_tangent - x_tangent.mean(-1, keepdims=True) - normed * (normed * x_tangent).mean(-1, keepdims=True)
    tangent = along * (per_deviation * scale[None]) + normed * scale_tangent[None] + bias_tangent[None]
    return layer_norm(x, scale, bias), tangent


def _statistics(x: Float[Array, "n c"]) -> tuple[Float[Array, "n 1"], Float[Array, "n 1"]]:
    """Mean and reciprocal standard deviation of each row."""
    mean = x.mean(-1, keepdims=True)
    variance = jnp.maximum((x * x).mean(-1, keepdims=True) - mean * mean, 0.0)
    return mean, jax.lax.rsqrt(variance + EPSILON)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def maximum(x: Float[Array, "*dims"], axes: tuple[int, ...]) -> Float[Array, "*rest"]:
    """Maximum over some axes. All entries within rounding of the maximum share its gradient.

    The gradient of `jnp.max` goes to the entries equal to the maximum. XLA may compute `x` again for the gradient and
    round it differently. Then no entry is equal, and the gradient is 0 / 0.
    """
    return x.max(axes)


@maximum.defjvp
def _(axes: tuple[int, ...], primals: tuple[Array], tangents: tuple[Array]):
    (x,), (x_tangent,) = primals, tangents
    y = x.max(axes, keepdims=True)
    equal = x >= y - ROUNDING * (1 + jnp.abs(y))
    return y.squeeze(axes), jnp.where(equal, x_tangent, 0).sum(axes) / jnp.maximum(equal.sum(axes), 1)


def residual_sums(
    features: Float[Array, "b n d"], assignment: Float[Array, "b n k"], centres: Float[ArrayLike, "d k"]
) -> Float[Array, "b d k"]:
    """Sum the residuals of local features per cluster, as in NetVLAD, each sum L2-normalised over d, in float32.

    vlad[d, k] = sum over n of assignment[n, k] * (features[n, d] - centres[d, k])
    """
    weights = assignment.astype(features.dtype)
    sums = jnp.einsum("bnd,bnk->bdk", features, weights, preferred_element_type=jnp.float32)
    return l2_normalize(sums - assignment.sum(1)[:, None, :] * jnp.asarray(centres)[None], axis=1)


def l2_normalize(x: Float[Array, "*dims"], *, axis: int = -1) -> Float[Array, "*dims"]:
    """Scale vectors along `axis` to length 1.

    A vector shorter than 1e-12 becomes 0 with gradient 0. The gradient of the plain quotient is NaN at 0.
    """
    square = jnp.sum(x * x, axis=axis, keepdims=True)
    has_direction = square > NORM_FLOOR**2
    return x * jnp.where(has_direction, jax.lax.rsqrt(jnp.where(has_direction, square, 1.0)), 0.0)
