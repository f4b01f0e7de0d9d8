"""Initial values of weights. numpy draws them, because JAX compiles a program for each distribution and shape.

The values depend on the key, the name and the shape of a weight. They are equal on all devices.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32
from scipy.special import ndtr, ndtri

Draw = Callable[[np.random.Generator, tuple[int, ...]], Float32[np.ndarray, "*shape"]]
TRUNCATED_AT = 2.0
"""Deviations at which a truncated normal distribution ends."""


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Initial:
    """Distribution of the initial values of a weight, which is also an initializer for Flax."""

    draw: Draw

    def __call__(self, key: Array, shape: tuple[int, ...]) -> Float32[Array, "*shape"]:
        """Draw the values of one weight."""
        drawn: Any = draw_all(key, {"": self}, {"": jax.ShapeDtypeStruct(shape, jnp.float32)})
        return drawn[""]


Initializer = Initial | Callable[[Array, tuple[int, ...]], Array]
"""Initial values of a weight of a model, or of one of Flax."""


def draw_all(key: Array, initial: Any, shapes: Any) -> Any:
    """Draw the values of all weights of a tree. The key may be traced.

    Arguments:
      key: Key of JAX.
      initial: An `Initial` for each weight, in nested dictionaries.
      shapes: Shape and data type of each weight, in the same dictionaries.

    Raises:
      KeyError: If a weight has no initial values.
    """
    leaves, tree = jax.tree_util.tree_flatten_with_path(shapes)

    def draw(seed: list[int], path: tuple[Any, ...], leaf: Any) -> np.ndarray:
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        one = functools.reduce(lambda tree, step: tree[step.key], path, initial)
        return one.draw(np.random.default_rng([*seed, *name.encode()]), leaf.shape).astype(leaf.dtype)

    def drawn(words: Any) -> list[np.ndarray]:
        seed = [int(word) for word in np.asarray(words).reshape(-1)]
        return [draw(seed, path, leaf) for path, leaf in leaves]

    words = jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key
    if isinstance(words, jax.core.Tracer):
        found = jax.pure_callback(drawn, [leaf for _, leaf in leaves], words, vmap_method="sequential")
    else:  # a callback would be compiled
        found = jax.device_put(drawn(words))
    return jax.tree_util.tree_unflatten(tree, found)


def constant(value: float) -> Initial:
    """Every weight has this value."""
    return Initial(lambda rng, shape: np.full(shape, value, np.float32))


def normal(deviation: float) -> Initial:
    """N(0, deviation ** 2)."""
    return Initial(lambda rng, shape: np.float32(deviation) * rng.standard_normal(shape, np.float32))


def scaled_normal(scale: float, *, truncated: bool = False) -> Initial:
    """Normal distribution with variance `scale` / number of inputs, truncated at two deviations if requested.

    The variance is that of the truncated distribution. Scale 2 is He's initialisation, 1 is LeCun's.
    """
    low = ndtr(-TRUNCATED_AT) if truncated else 0.0
    density = math.exp(-(TRUNCATED_AT**2) / 2) / math.sqrt(2 * math.pi)
    after_truncation = math.sqrt(1 - 2 * TRUNCATED_AT * density / (1 - 2 * low)) if truncated else 1.0

    def draw(rng: np.random.Generator, shape: tuple[int, ...]) -> Float32[np.ndarray, "*shape"]:
        deviation = math.sqrt(scale / _inputs(shape)) / after_truncation
        values = ndtri(rng.uniform(low, 1 - low, shape)) if truncated else rng.standard_normal(shape)
        return np.float32(deviation) * values.astype(np.float32)

    return Initial(draw)


def uniform(bound: float) -> Initial:
    """U(-bound, bound)."""
    return Initial(lambda rng, shape: rng.uniform(-bound, bound, shape).astype(np.float32))


def _inputs(shape: tuple[int, ...]) -> int:
    """Number of inputs of each output of a kernel."""
    return math.prod(shape[:-1])


zeros = constant(0.0)
ones = constant(1.0)
identity = Initial(lambda rng, shape: np.eye(*shape, dtype=np.float32))
he_normal = scaled_normal(2.0, truncated=True)
lecun_normal = scaled_normal(1.0, truncated=True)
torch_uniform = Initial(
    lambda rng, shape: rng.uniform(-(_inputs(shape) ** -0.5), _inputs(shape) ** -0.5, shape).astype(np.float32)
)
"""PyTorch's default initialisation of convolutions, U(-1/sqrt(fan_in), 1/sqrt(fan_in))."""
