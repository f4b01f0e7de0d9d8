"""The linear layer, layer norm and initial values that all modules share, set as the PyTorch reference has them.

Weights are float32. Layers multiply in the type of their input, so that a network computes in the type of its image
(`ModelConfig.compute`) but where a module asks for float32.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def weight(module: nn.Module, name: str, init: Callable, shape: tuple[int, ...]) -> Any:
    """A weight of the module that calls it. ValueError for one of another shape.

    Flax's `param` traces `init` in every call to know the shape: half of the time that tracing a network takes.
    """
    if not module.has_variable("params", name):
        return module.param(name, init, shape)
    value = module.get_variable("params", name)
    if value.shape != shape:
        raise ValueError(f"{'/'.join((*module.path, name))}: expected weights of shape {shape}, found {value.shape}")
    return value


class Linear(nn.Module):
    """A dense layer with weights N(0, 0.02) and bias 0, computed as one product of two matrices.

    XLA's CPU backend is three times slower at the same product with the leading axes left apart.
    """

    features: int
    use_bias: bool = True
    kernel_init: Callable = nn.initializers.normal(0.02)

    @nn.compact
    def __call__(self, x: Float[Array, "*b c"]) -> Float[Array, "*b {self.features}"]:
        """The same linear map of every vector of `c` channels."""
        c = x.shape[-1]
        kernel = weight(self, "kernel", self.kernel_init, (c, self.features)).astype(x.dtype)
        y = product(x.reshape(-1, c), jnp.asarray(kernel))
        if self.use_bias:
            y = y + weight(self, "bias", nn.initializers.zeros, (self.features,)).astype(x.dtype)[None]
        return y.reshape(*x.shape[:-1], self.features)


@jax.custom_jvp
def product(x: Float[Array, "n c"], matrix: Float[Array, "c f"]) -> Float[Array, "n f"]:
    """The product of many rows and a matrix.

    The gradient of the matrix sums over the rows, and XLA's CPU backend rearranges whichever factor comes first before
    it does: up to half of the time where that is the wider one, which it would be for a matrix of more rows than
    columns. The barrier keeps XLA from exchanging them again.
    """
    return x @ matrix


@product.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]):
    (x, matrix), (x_tangent, matrix_tangent) = primals, tangents
    if len(x) > len(matrix) > matrix.shape[1]:
        turned = jax.lax.optimization_barrier(matrix_tangent.T)
        by_matrix = jax.lax.dot_general(x, turned, (((1,), (1,)), ((), ())))
    else:
        by_matrix = x @ matrix_tangent
    return product(x, matrix), x_tangent @ matrix + by_matrix


def gelu(x: Float[Array, "*dims"]) -> Float[Array, "*dims"]:
    """The exact GELU, x times the normal distribution function, by erf: `jax.nn.gelu` takes the costlier erfc."""
    return 0.5 * x * (1 + jax.lax.erf(x * math.sqrt(0.5)))


class LayerNorm(nn.Module):
    """Layer norm over channels with PyTorch's epsilon; within it everything is float32.

    The arithmetic of Flax's, whose initial values would be traced in every call (see `weight`).
    """

    epsilon: float = 1e-5

    @nn.compact
    def __call__(self, x: Float[Array, "*b c"]) -> Float[Array, "*b c"]:
        """Keeps the type of its input."""
        scale = jnp.asarray(weight(self, "scale", nn.initializers.ones, x.shape[-1:]))
        bias = jnp.asarray(weight(self, "bias", nn.initializers.zeros, x.shape[-1:]))
        rows = x.astype(jnp.float32).reshape(-1, x.shape[-1])
        return layer_norm(rows, scale, bias, self.epsilon).astype(x.dtype).reshape(x.shape)


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def layer_norm(
    x: Float[Array, "n c"], scale: Float[Array, " c"], bias: Float[Array, " c"], epsilon: float
) -> Float[Array, "n c"]:
    """Layer norm of every row. Its derivative is written out: XLA makes more passes over the rows for JAX's."""
    mean, per_deviation = _statistics(x, epsilon)
    return (x - mean) * (per_deviation * scale[None]) + bias[None]


@layer_norm.defjvp
def _(epsilon: float, primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]):
    (x, scale, bias), (x_tangent, scale_tangent, bias_tangent) = primals, tangents
    mean, per_deviation = _statistics(x, epsilon)
    normed = (x - mean) * per_deviation
    along = x_tangent - _mean(x_tangent) - normed * _mean(normed * x_tangent)
    tangent = along * (per_deviation * scale[None]) + normed * scale_tangent[None] + bias_tangent[None]
    return layer_norm(x, scale, bias, epsilon), tangent


def _statistics(x: Float[Array, "n c"], epsilon: float) -> tuple[Float[Array, "n 1"], Float[Array, "n 1"]]:
    """The mean of each row, and 1 / its standard deviation."""
    mean = _mean(x)
    variance = jnp.maximum(_mean(x * x) - mean * mean, 0.0)
    return mean, jax.lax.rsqrt(variance + epsilon)


def _mean(x: Float[Array, "n c"]) -> Float[Array, "n 1"]:
    return x.mean(-1, keepdims=True)


torch_uniform = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")
"""PyTorch's default for convolutions, U(-1/sqrt(fan_in), 1/sqrt(fan_in))."""

NORM_FLOOR = 1e-12


def l2_normalize(x: Float[Array, "*dims"], *, axis: int = -1) -> Float[Array, "*dims"]:
    """Scales vectors along `axis` to length 1.

    A vector shorter than 1e-12 has no direction: it becomes 0, with gradient 0 (the plain quotient's is NaN at 0).
    """
    square = jnp.sum(x * x, axis=axis, keepdims=True)
    has_direction = square > NORM_FLOOR**2
    return x * jnp.where(has_direction, jax.lax.rsqrt(jnp.where(has_direction, square, 1.0)), 0.0)
