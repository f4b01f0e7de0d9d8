"""Maximum of features along an axis, for networks on points and graphs."""

import jax
from jaxtyping import Array, Float


def maximum(x: Float[Array, "..."], axis: int) -> Float[Array, "..."]:
    """Return the maximum along an axis, with a derivative that is always finite.

    The derivative divides by the number of values that equal the maximum. XLA may compute the values a second time,
    with other rounding. Then no value equals the maximum. The barrier makes XLA keep the values.
    """
    return jax.lax.optimization_barrier(x).max(axis)
