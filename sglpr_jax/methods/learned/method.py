"""Interface of a learned method: network, input, loss and recipe. Rotations and losses that several methods share."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Float32, Shaped

from sglpr_jax.bev import rotate_points
from sglpr_jax.data.scan import Scan, check_cloud
from sglpr_jax.losses import descriptor_distance, lazy_triplet
from sglpr_jax.methods.method import Takes
from sglpr_jax.methods.recipe import Recipe

MARGIN, OTHER_MARGIN = 0.5, 0.2
"""Margins of the lazy quadruplet loss."""
Variables = Mapping[str, Any]
"""Variables of a network: `params`, and `batch_stats` if it has batch normalisation."""


class Tuples(NamedTuple):
    """Descriptors of a training batch. Column 0 is the anchor; positives and negatives follow."""

    descriptors: Float[Array, "t k d"]
    apart_m: Float[Array, "t k"]
    """Distance of each place from the anchor, in metres. Infinite between recordings."""
    positives: int
    """Number of positives of each anchor."""


@dataclass(frozen=True)
class LearnedMethod:
    """A network of another publication, as declared by its file in `learned/`.

    `network.apply(variables, inputs, train=False)` returns one descriptor for each input. With `train=True` and
    `mutable=["batch_stats"]` it updates the statistics of its batch normalisation.
    """

    name: str
    """Name on the command line."""
    source: str
    """Publication of the method."""
    licence: str
    """Licence of the authors' code, for example "MIT", or "GPL-3.0, not read"."""
    takes: Takes
    weights: int
    """Number of trained weights."""
    network: nn.Module
    prepare: Callable[[Scan], Shaped[np.ndarray, "..."]]
    """Makes the input of the network from a scan. All inputs have one shape and type."""
    rotate_inputs: Callable[[Array, Shaped[Array, "b ..."]], Shaped[Array, "b ..."]]
    """Rotates each input about the vertical axis by its own random angle, given a random key, for the training."""
    loss: Callable[[Variables, Tuples], Float[Array, ""]]
    recipe: Recipe
    compare: Callable[[Variables, Float[Array, "q d"], Float[Array, "n d"]], Float[Array, "q n"]] | None = None
    """Distances between the descriptors of queries and of a database, if they need the weights. None: L2."""
    start: Callable[[Variables, Shaped[np.ndarray, "n ..."]], Variables] | None = None
    """Changes random weights before the first step, given the inputs of random training places."""


def finite_points(scan: Scan) -> Float32[np.ndarray, "n 3"]:
    """Return the finite points of a scan, gravity-aligned. Raises ValueError if the scan shows no place."""
    points = scan.upright_points
    check_cloud(points, name=scan.name)
    return points[np.isfinite(points).all(axis=1)]


def roll_azimuths(key: Array, inputs: Shaped[Array, "b r s *_"]) -> Shaped[Array, "b r s *_"]:
    """Roll each input along the axis after the first one, the azimuths, by its own random number of columns."""
    shifts = jax.random.randint(key, (len(inputs),), 0, inputs.shape[2])
    return jax.vmap(lambda image, shift: jnp.roll(image, shift, axis=1))(inputs, shifts)


def rotate_clouds(key: Array, points: Float[Array, "b n c"]) -> Float[Array, "b n c"]:
    """Rotate the first three coordinates of the points of each input about z by its own random angle."""
    angles = jax.random.uniform(key, (len(points),), maxval=2 * jnp.pi)
    return points.at[..., :3].set(rotate_points(points[..., :3], angles))


def triplet(variables: Variables, tuples: Tuples, *, squared: bool = False, **options) -> Float[Array, ""]:
    """Return the mean over the tuples of `losses.lazy_triplet` with these options, with d = L2 or its square."""
    return lazy_triplet(*_anchor_distances(tuples, squared=squared), **options).mean()


def quadruplet(variables: Variables, tuples: Tuples, *, closest_positive: bool) -> Float[Array, ""]:
    """Return the mean over the tuples of the lazy quadruplet loss, with d = L2 squared.

        max over negatives of [0.5 + d(anchor, p) - d(anchor, n)]_+ + the same of [0.2 + d(anchor, p) - d(o, n)]_+

    p is the closest or the farthest positive. The published other negative o is far from all places of the tuple. Here
    it is the anchor of the next tuple, at any distance from the negatives. A single tuple has no second term.
    """
    positive, negative = _anchor_distances(tuples, squared=True)
    total = lazy_triplet(positive, negative, margin=MARGIN, closest_positive=closest_positive)
    if len(tuples.descriptors) > 1:
        others = jnp.roll(tuples.descriptors[:, :1], -1, axis=0)
        negatives = tuples.descriptors[:, 1 + tuples.positives :]
        between = descriptor_distance(*jnp.broadcast_arrays(others, negatives), squared=True)
        total = total + lazy_triplet(positive, between, margin=OTHER_MARGIN, closest_positive=closest_positive)
    return total.mean()


def _anchor_distances(tuples: Tuples, *, squared: bool) -> list[Float[Array, "t _"]]:
    """Return the distances of the anchors to their positives and to their negatives."""
    anchors, others = tuples.descriptors[:, :1], tuples.descriptors[:, 1:]
    distances = descriptor_distance(*jnp.broadcast_arrays(anchors, others), squared=squared)
    return jnp.split(distances, [tuples.positives], axis=1)
