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

MARGIN, SECOND_MARGIN = 0.5, 0.2
"""Margins of the two terms of the lazy quadruplet loss."""
Variables = Mapping[str, Any]
"""Variables of a network: `params`, and `batch_stats` if it has batch normalisation."""


class Tuples(NamedTuple):
    """Descriptors of a training batch: t tuples of k places. Place 0 is the anchor; positives and negatives follow."""

    descriptors: Float[Array, "t k d"]
    apart_m: Float[Array, "t k"]
    """Distance of each place from the anchor of its tuple, in metres. Infinite between worlds (`Recording.world`)."""
    positives: int
    """Number of positives of each anchor."""


@dataclass(frozen=True)
class LearnedMethod:
    """A network of another publication, as declared by its file in `learned/`."""

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
    """`apply(variables, inputs, train=False)` returns one descriptor for each input. With `train=True` and
    `mutable=["batch_stats"]` it updates the statistics of its batch normalisation."""
    prepare: Callable[[Scan], Shaped[np.ndarray, "..."]]
    """Converts a scan to the input of the network. All inputs have one shape and type."""
    rotate_inputs: Callable[[Array, Shaped[Array, "b ..."]], Shaped[Array, "b ..."]]
    """Rotates each input of a training batch about the vertical axis by its own random angle, given a random key."""
    loss: Callable[[Variables, Tuples], Float[Array, ""]]
    recipe: Recipe
    compare: Callable[[Variables, Float[Array, "q d"], Float[Array, "n d"]], Float[Array, "q n"]] | None = None
    """Learned distances, given the variables and the descriptors of queries and of a database. None: L2."""
    start: Callable[[Variables, Shaped[np.ndarray, "n ..."]], Variables] | None = None
    """Changes random weights before the first step, given the inputs of random training places."""


def finite_points(scan: Scan) -> Float32[np.ndarray, "n 3"]:
    """Return the finite points of a scan, gravity-aligned. Raises ValueError if it shows no place (`check_cloud`)."""
    points = scan.upright_points
    check_cloud(points, name=scan.name)
    return points[np.isfinite(points).all(axis=1)]


def roll_azimuths(key: Array, inputs: Shaped[Array, "b r s *_"]) -> Shaped[Array, "b r s *_"]:
    """Roll each polar input (rings or rows, sectors, ...) along the sectors by its own random number."""
    shifts = jax.random.randint(key, (len(inputs),), 0, inputs.shape[2])
    return jax.vmap(lambda image, shift: jnp.roll(image, shift, axis=1))(inputs, shifts)


def rotate_clouds(key: Array, points: Float[Array, "b n c"]) -> Float[Array, "b n c"]:
    """Rotate the first three coordinates of the points of each input about z by its own random angle."""
    angles = jax.random.uniform(key, (len(points),), maxval=2 * jnp.pi)
    return points.at[..., :3].set(rotate_points(points[..., :3], angles))


def triplet(variables: Variables, tuples: Tuples, *, squared: bool = False, **options) -> Float[Array, ""]:
    """Return the mean of `losses.lazy_triplet` over the tuples, with the L2 distance or its square."""
    positive, negative = _anchor_distances(tuples, squared=squared)
    return lazy_triplet(positive, negative, **options).mean()


def quadruplet(variables: Variables, tuples: Tuples, *, closest_positive: bool) -> Float[Array, ""]:
    """Return the mean of the lazy quadruplet loss over the tuples, with d = L2 squared:

        max over negatives n of [0.5 + d(anchor, p) - d(anchor, n)]_+ + max over n of [0.2 + d(anchor, p) - d(o, n)]_+

    p is the closest or the farthest positive. The published fourth place o is far from all places of the tuple. Here it
    is the anchor of the next tuple, at any distance. A single tuple has no second term.
    """
    positive, negative = _anchor_distances(tuples, squared=True)
    losses = lazy_triplet(positive, negative, margin=MARGIN, closest_positive=closest_positive)
    if len(tuples.descriptors) > 1:
        next_anchors = jnp.roll(tuples.descriptors[:, :1], -1, axis=0)
        negatives = tuples.descriptors[:, 1 + tuples.positives :]
        distances = descriptor_distance(*jnp.broadcast_arrays(next_anchors, negatives), squared=True)
        losses = losses + lazy_triplet(positive, distances, margin=SECOND_MARGIN, closest_positive=closest_positive)
    return losses.mean()


def _anchor_distances(tuples: Tuples, *, squared: bool) -> list[Float[Array, "t _"]]:
    """Return the distances of the anchors to their positives and to their negatives."""
    anchors, others = tuples.descriptors[:, :1], tuples.descriptors[:, 1:]
    distances = descriptor_distance(*jnp.broadcast_arrays(anchors, others), squared=squared)
    return jnp.split(distances, [tuples.positives], axis=1)
