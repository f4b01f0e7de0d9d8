"""Layers that all networks share: linear layer, GELU, layer norm, maximum and L2 normalisation.

Weights are float32. Layers multiply in the data type of their input, so a network computes in the type of its image
(`ModelConfig.compute`).
"""

import functools
import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sglpr_jax.models import initial
from sglpr_jax.models.initial import Initial, Initializer

EPSILON = 1e-5
"""PyTorch's epsilon of a layer norm."""
NORM_FLOOR = 1e-12
"""Length below which `l2_normalize` gives 0."""
ROUNDING = 1e-6
"""Relative difference from the maximum below which an entry counts as equal to it."""


def weight(module: nn.Module, name: str, init: Initializer, shape: tuple[int, ...]) -> Any:
    """Return a weight of the calling module. At initialisation, create it and store `init` for `draw_all`.

    This function replaces Flax's `param`, which takes half of the time of tracing a network.

    Raises ValueError if the weight has another shape.
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
    """Dense layer with initial weights N(0, 0.02) and bias 0. One product for all leading axes is fast on a CPU."""

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
    """Return x @ matrix, for many rows x, with a derivative that is fast on a CPU."""
    return x @ matrix


@product.defjvp
def _product_derivative(primals: tuple[Array, Array], tangents: tuple[Array, Array]):
    (x, matrix), (x_tangent, matrix_tangent) = primals, tangents
    if len(x) > len(matrix) > matrix.shape[1]:
        # The same as x @ matrix_tangent. Its gradient has the narrow factor first, which XLA's CPU backend rearranges.
        # The barrier keeps XLA from undoing the transposition.
        transposed = jax.lax.optimization_barrier(matrix_tangent.T)
        change_by_matrix = jax.lax.dot_general(x, transposed, (((1,), (1,)), ((), ())))
    else:
        change_by_matrix = x @ matrix_tangent
    return product(x, matrix), x_tangent @ matrix + change_by_matrix


def gelu(x: Float[Array, "*dims"]) -> Float[Array, "*dims"]:
    """Return x times the normal distribution function. This uses erf; `jax.nn.gelu` uses the slower erfc."""
    return 0.5 * x * (1 + jax.lax.erf(x * math.sqrt(0.5)))


class LayerNorm(nn.Module):
    """Layer norm over channels, computed in float32."""

    @nn.compact
    def __call__(self, x: Float[Array, "*b c"]) -> Float[Array, "*b c"]:
        scale = jnp.asarray(weight(self, "scale", initial.ones, x.shape[-1:]))
        bias = jnp.asarray(weight(self, "bias", initial.zeros, x.shape[-1:]))
        rows = x.astype(jnp.float32).reshape(-1, x.shape[-1])
        return layer_norm(rows, scale, bias).astype(x.dtype).reshape(x.shape)


@jax.custom_jvp
def layer_norm(x: Float[Array, "n c"], scale: Float[Array, " c"], bias: Float[Array, " c"]) -> Float[Array, "n c"]:
    """Normalise every row, with a derivative for which XLA reads the rows less often than for JAX's own."""
    mean, reciprocal_deviation = _mean_and_reciprocal_deviation(x)
    return (x - mean) * (reciprocal_deviation * scale[None]) + bias[None]


@layer_norm.defjvp
def _layer_norm_derivative(primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]):
    (x, scale, bias), (x_tangent, scale_tangent, bias_tangent) = primals, tangents
    mean, reciprocal_deviation = _mean_and_reciprocal_deviation(x)
    normed = (x - mean) * reciprocal_deviation
    centred = x_tangent - x_tangent.mean(-1, keepdims=True)
    across = centred - normed * (normed * x_tangent).mean(-1, keepdims=True)  # without the part along `normed`
    tangent = across * (reciprocal_deviation * scale[None]) + normed * scale_tangent[None] + bias_tangent[None]
    return layer_norm(x, scale, bias), tangent


def _mean_and_reciprocal_deviation(x: Float[Array, "n c"]) -> tuple[Float[Array, "n 1"], Float[Array, "n 1"]]:
    """Return the mean of each row, and 1 / (its standard deviation)."""
    mean = x.mean(-1, keepdims=True)
    variance = jnp.maximum((x * x).mean(-1, keepdims=True) - mean * mean, 0.0)
    return mean, jax.lax.rsqrt(variance + EPSILON)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def maximum(x: Float[Array, "*dims"], axes: tuple[int, ...]) -> Float[Array, "*rest"]:
    """Return the maximum over some axes. All entries within `ROUNDING` of the maximum share its gradient.

    With `jnp.max`, the entries equal to the maximum share it. XLA may compute `x` again for the gradient and round it
    differently. Then no entry is equal, and the gradient is 0 / 0.
    """
    return x.max(axes)


@maximum.defjvp
def _maximum_derivative(axes: tuple[int, ...], primals: tuple[Array], tangents: tuple[Array]):
    (x,), (x_tangent,) = primals, tangents
    y = x.max(axes, keepdims=True)
    is_maximum = x >= y - ROUNDING * (1 + jnp.abs(y))
    return y.squeeze(axes), jnp.where(is_maximum, x_tangent, 0).sum(axes) / jnp.maximum(is_maximum.sum(axes), 1)


def l2_normalize(x: Float[Array, "*dims"], *, axis: int = -1) -> Float[Array, "*dims"]:
    """Scale vectors along `axis` to length 1. Vectors shorter than 1e-12 become 0 with gradient 0 instead of NaN."""
    square = jnp.sum(x * x, axis=axis, keepdims=True)
    has_direction = square > NORM_FLOOR**2
    return x * jnp.where(has_direction, jax.lax.rsqrt(jnp.where(has_direction, square, 1.0)), 0.0)
