"""Maximum of features along an axis, for networks on points and graphs."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def maximum(x: Float[Array, "..."], axis: int) -> Float[Array, "..."]:
    """Return the maximum along an axis. Its derivative reaches one of the largest values.

    The derivative of `jnp.max` divides by the number of values that equal the maximum. On a CPU, XLA may compute the
    values a second time with other rounding. Then this number is 0, and the derivative is NaN.
    """
    place = jnp.argmax(jax.lax.stop_gradient(x), axis, keepdims=True)
    return jnp.take_along_axis(x, place, axis, mode="promise_in_bounds").squeeze(axis)
