"""Distances of the descriptors of learned methods, for arrays of any size."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32

from sglpr_jax.methods.learned.method import LearnedMethod, Variables
from sglpr_jax.methods.method import DistanceFn
from sglpr_jax.methods.pairwise import in_blocks

BLOCK = 512


def learned_distance(method: LearnedMethod, variables: Variables) -> DistanceFn:
    """Return the distance of a trained method: its own one, or L2 if it has none.

    Arguments:
      method: Method of the descriptors.
      variables: Weights of its network.
    """
    own = method.compare
    compare = jax.jit(_l2 if own is None else lambda queries, database: own(variables, queries, database))

    def of_block(queries: tuple[Any, int], database: tuple[Any, int]) -> np.ndarray:
        (a, q), (b, n) = queries, database
        return np.asarray(compare(a, b))[:q, :n]

    def distance(queries: Float32[np.ndarray, "q d"], database: Float32[np.ndarray, "n d"]) -> np.ndarray:
        return in_blocks(of_block, queries, database, block=BLOCK, prepare=_padded)

    return distance


def _l2(queries: jax.Array, database: jax.Array) -> jax.Array:
    return jax.lax.map(lambda query: jnp.sqrt(jnp.square(query[None] - database).sum(-1)), queries)


def _padded(rows: Float32[np.ndarray, "n d"]) -> tuple[Float32[np.ndarray, "m d"], int]:
    """Return the rows, padded to a power of two so that few sizes are compiled, and their number."""
    missing = 2 ** max(len(rows) - 1, 0).bit_length() - len(rows)
    return np.pad(rows, ((0, missing), (0, 0))), len(rows)
