"""Distance functions of descriptors, by the name in a descriptor file (`DescriptorFile.distance`).

Every function takes queries (q, d) and a database (n, d), float32, and returns distances (q, n), float32. It works in
blocks, to need little memory besides the result.
"""

import difflib

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.method import DistanceFn
from sglpr_jax.methods.names import LEARNED_NAMES
from sglpr_jax.methods.pairwise import cosine, l2


def smallest(values: Float[np.ndarray, "q n"], k: int) -> Int[np.ndarray, "q {k}"]:
    """Return the columns of the k smallest values of each row, in ascending order. Ties are in the order of columns."""
    if k == 1:
        return np.argmin(values, axis=1)[:, None]
    columns = np.sort(np.argpartition(values, k - 1, axis=1)[:, :k], axis=1)
    largest = np.take_along_axis(values, columns, axis=1).max(axis=1, keepdims=True)
    for row in np.flatnonzero((values <= largest).sum(axis=1) > k):  # other columns tie with the k-th one
        columns[row] = np.sort(np.argsort(values[row], kind="stable")[:k])
    order = np.argsort(np.take_along_axis(values, columns, axis=1), axis=1, kind="stable")
    return np.take_along_axis(columns, order, axis=1)


DISTANCES: dict[str, DistanceFn] = {
    "l2": l2,
    "cosine": cosine,
    **{name: method.distance for name, method in HANDCRAFTED.items() if method.distance is not None},
}
"""All distances by name."""


def distance_function(name: str) -> DistanceFn:
    """Return the distance function `name`: one of `DISTANCES`, or a learned one, `METHOD:FOLDER#HASH` of its weights.

    Raises:
      FileNotFoundError: If the weights of a learned distance do not exist.
      ValueError: If the name is unknown (the message suggests one), or if the weights have another hash.
    """
    method = name.partition(":")[0]
    if method in LEARNED_NAMES:
        from sglpr_jax.methods.learned import LEARNED  # slow import: the networks
        from sglpr_jax.methods.learned.trained import distance_named

        return distance_named(LEARNED[method], name)
    if name not in DISTANCES:
        near = difflib.get_close_matches(name, DISTANCES, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ValueError(f"expected a distance among {', '.join(DISTANCES)}, found {name!r:.60}{hint}")
    return DISTANCES[name]
