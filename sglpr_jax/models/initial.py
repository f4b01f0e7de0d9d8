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

Draw = Callable[[np.random.Generator, tuple[int, ...]], Float32[np.ndarray, "*shape"]]
TRUNCATED_AT = 2.0
"""Number of standard deviations at which a truncated normal distribution ends."""


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Initial:
    """Distribution of the initial values of a weight. `initial(key, shape)` draws them, as Flax expects."""

    draw: Draw

    def __call__(self, key: Array, shape: tuple[int, ...]) -> Float32[Array, "*shape"]:
        return draw_all(key, {"": self}, {"": jax.ShapeDtypeStruct(shape, jnp.float32)})[""]


Initializer = Initial | Callable[[Array, tuple[int, ...]], Array]
"""Initial values of a weight of a model, or of one of Flax."""


def draw_all(key: Array, initials: Any, shapes: Any) -> Any:
    """Draw the values of all weights of a tree. The key may be traced.

    Arguments:
      key: Random key of JAX, new style or old.
      initials: An `Initial` for each weight, in nested dictionaries.
      shapes: Shape and data type of each weight, in the same dictionaries.

    Raises:
      KeyError: If a weight has no initial values.
    """
    shape_by_path, tree = jax.tree_util.tree_flatten_with_path(shapes)

    def draw(key_integers: Any) -> list[np.ndarray]:
        seed = [int(integer) for integer in np.asarray(key_integers).reshape(-1)]
        values = []
        for path, shape in shape_by_path:
            name = jax.tree_util.keystr(path, simple=True, separator="/")
            initial = functools.reduce(lambda node, step: node[step.key], path, initials)  # follows the path
            rng = np.random.default_rng([*seed, *name.encode()])
            values.append(initial.draw(rng, shape.shape).astype(shape.dtype))
        return values

    key_integers = jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key
    if isinstance(key_integers, jax.core.Tracer):
        results = [shape for _, shape in shape_by_path]
        values = jax.pure_callback(draw, results, key_integers, vmap_method="sequential")
    else:  # without a callback, which JAX would compile
        values = jax.device_put(draw(key_integers))
    return jax.tree_util.tree_unflatten(tree, values)


def constant(value: float) -> Initial:
    return Initial(lambda rng, shape: np.full(shape, value, np.float32))


def normal(deviation: float) -> Initial:
    return Initial(lambda rng, shape: np.float32(deviation) * rng.standard_normal(shape, np.float32))


def truncated_normal(scale: float) -> Initial:
    """Normal distribution, truncated at 2 standard deviations, of variance `scale` / (number of inputs) after that."""
    lowest_probability = math.erfc(TRUNCATED_AT / math.sqrt(2)) / 2
    density = math.exp(-(TRUNCATED_AT**2) / 2) / math.sqrt(2 * math.pi)
    narrowing = math.sqrt(1 - 2 * TRUNCATED_AT * density / (1 - 2 * lowest_probability))

    def draw(rng: np.random.Generator, shape: tuple[int, ...]) -> Float32[np.ndarray, "*shape"]:
        from scipy.special import ndtri  # imported here because the import is slow

        deviation = math.sqrt(scale / math.prod(shape[:-1])) / narrowing
        probability = rng.uniform(lowest_probability, 1 - lowest_probability, shape)
        return np.float32(deviation) * ndtri(probability).astype(np.float32)

    return Initial(draw)


def uniform(bound: float) -> Initial:
    return Initial(lambda rng, shape: rng.uniform(-bound, bound, shape).astype(np.float32))


zeros = constant(0.0)
ones = constant(1.0)
identity = Initial(lambda rng, shape: np.eye(*shape, dtype=np.float32))
he_normal = truncated_normal(2.0)
lecun_normal = truncated_normal(1.0)
torch_uniform = Initial(lambda rng, shape: uniform(math.prod(shape[:-1]) ** -0.5).draw(rng, shape))
"""PyTorch's default initialisation of convolutions, U(-1/sqrt(inputs), 1/sqrt(inputs))."""
