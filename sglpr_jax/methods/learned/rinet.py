"""RINet (Li et al., 2022), variant with attention: a ring of ranges for each of 12 classes, and a learned distance.

Published recipe: Adam 0.02, weight decay 1e-6; cross entropy of a soft label and contrastive loss; 1024 pairs, 20
epochs. Differences: 512 tuples of one positive and one negative, that is 1024 pairs, and half of the positives from
another visit. Each scan loses its own random columns. Scans are not paired with themselves.
"""

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn
from jaxtyping import Array, Float, Float32

from sglpr_jax.data.scan import Scan
from sglpr_jax.data.views import classes_of
from sglpr_jax.losses import descriptor_distance
from sglpr_jax.methods.cells import extreme_of_cells, polar
from sglpr_jax.methods.learned.layers import batch_norm
from sglpr_jax.methods.learned.method import LearnedMethod, Tuples, Variables
from sglpr_jax.methods.recipe import Recipe, TupleConfig

COLUMNS = 360
RANGE_M = 50.0
CLASSES = (1, *range(9, 20))
"""Classes of the rows: car, road, parking, sidewalk, other ground, building, fence, vegetation, ..., traffic sign."""
ROAD = 1
"""Row of the road, which holds the range of the farthest point. The other rows hold the nearest one."""
STAGES = ((3, 16), (3, 32), (2, 32), (2, 64), (2, 128))
"""Factor by which the ring is reduced, and number of channels, of each stage after the first one."""
SLOPE = 0.1
"""Slope of the leaky ReLU for negative numbers."""
SAME_M, HALF_M, WIDTH_M = 3.0, 10.0, 1.5
"""The label of a pair of scans is 1 up to a distance of 3 m, then a sigmoid: 0.5 at 10 m, with a width of 1.5 m."""
LIMIT_M = 13.3
"""Distance at which the label is 0.1, in metres: the limit between positives and negatives."""
MARGIN = 0.2
LOST_COLUMNS = 60
"""Maximum number of columns that training removes from a scan, as if an obstacle hid them."""


def ring_image(scan: Scan) -> Float32[np.ndarray, "12 360"]:
    """Return the horizontal range of the nearest point of each of the `CLASSES` in each degree, divided by 50 m.

    For the road, it is the farthest point. Columns are degrees from -180, counter-clockwise. Cells without points
    within 50 m are 0. Raises ValueError if the scan has no labels.
    """
    points, classes = scan.upright_points, classes_of(scan, 20)
    row_of_class = np.full(20, -1)
    row_of_class[list(CLASSES)] = np.arange(len(CLASSES))
    is_finite = np.isfinite(points).all(axis=1, keepdims=True)
    radius, angle, _ = polar(np.where(is_finite, points, np.inf))  # infinite points are dropped by their range
    row = row_of_class[classes]
    inside = (radius <= RANGE_M) & (row >= 0)
    # The remainder moves exactly 180 degrees from column 360 to column 0, -180 degrees. The authors drop such points.
    column = np.floor((angle[inside] + np.pi) * (COLUMNS / (2 * np.pi))).astype(np.int64) % COLUMNS
    cells, shape = (row[inside], column), (len(CLASSES), COLUMNS)
    image = extreme_of_cells(np.minimum, shape, cells, radius[inside])
    image[ROAD] = extreme_of_cells(np.maximum, shape, cells, radius[inside])[ROAD]
    return (image / RANGE_M).astype(np.float32)


def rotate_with_lost_columns(key: Array, inputs: Float[Array, "b 12 360"]) -> Float[Array, "b 12 360"]:
    """Rotate each input by a random number of columns. Before, half of them lose up to 60 neighbouring columns."""

    def rotate(key, image):
        loses_key, size_key, start_key, angle_key = jax.random.split(key, 4)
        lost_columns = jax.random.randint(size_key, (), 0, LOST_COLUMNS + 1) * jax.random.bernoulli(loses_key)
        start = jax.random.randint(start_key, (), 0, COLUMNS + 1 - lost_columns)
        column = jnp.arange(COLUMNS)
        is_kept = (column < start) | (column >= start + lost_columns)
        return jnp.roll(image * is_kept[None], jax.random.randint(angle_key, (), 0, COLUMNS), axis=1)

    return jax.vmap(rotate)(jax.random.split(key, len(inputs)), inputs)


class RINet(nn.Module):
    """The network of one scan. Rotations by whole degrees do not change its descriptor (`strongest_phase`)."""

    @nn.compact
    def __call__(self, inputs: Float[Array, "b 12 360"], *, train: bool) -> Float[Array, "b 288"]:
        """Return the means over the ring after each of the six stages, without normalisation."""
        x = Attention()(inputs.swapaxes(1, 2))
        x = Attention()(RingConvolution(12)(x, train=train))
        x = Attention()(RingConvolution(16)(x, train=train))
        means = [x.mean(1)]
        for factor, channels in STAGES:
            x = Attention()(RingConvolution(channels)(strongest_phase(x, factor), train=train))
            means.append(x.mean(1))
        descriptors = jnp.concatenate(means, axis=-1)
        if self.is_initializing():
            Score(name="score")(descriptors)  # creates the weights for `compare`
        return descriptors


class RingConvolution(nn.Module):
    """Convolution over columns i, i + 1 and i + 2 of a ring, batch normalisation and leaky ReLU."""

    channels: int

    @nn.compact
    def __call__(self, x: Float[Array, "b l c"], *, train: bool) -> Float[Array, "b l {self.channels}"]:
        padded_ring = jnp.concatenate([x, x[:, :2]], axis=1)
        x = nn.Conv(self.channels, (3,), padding="VALID")(padded_ring)
        return nn.leaky_relu(batch_norm(train)(x), SLOPE)


class Attention(nn.Module):
    """Scales each channel by a number from 0 to 1 that depends on the means of all channels."""

    @nn.compact
    def __call__(self, x: Float[Array, "b l c"]) -> Float[Array, "b l c"]:
        return x * nn.sigmoid(nn.Dense(x.shape[-1])(x.mean(1)))[:, None]


class Score(nn.Module):
    """Score of the absolute difference of two descriptors. Its sigmoid is the probability that they show one place."""

    @nn.compact
    def __call__(self, difference: Float[Array, "*b 288"]) -> Float[Array, "*b"]:
        hidden = nn.leaky_relu(nn.Dense(128)(difference), SLOPE)
        return nn.Dense(1)(hidden)[..., 0]


def strongest_phase(x: Float[Array, "b l c"], factor: int) -> Float[Array, "b l/{factor} c"]:
    """Keep every `factor`-th column, from the start (phase) that gives the largest sum of absolute values."""
    batch, length, channels = x.shape
    phases = x.reshape(batch, length // factor, factor, channels)
    best = jnp.argmax(jnp.abs(phases).sum((1, 3)), axis=-1)
    return jnp.take_along_axis(phases, best[:, None, None, None], axis=2)[:, :, 0]


def loss(variables: Variables, tuples: Tuples) -> Float[Array, ""]:
    """Return cross entropy of the scores plus contrastive loss, for the pairs of an anchor and another place."""
    anchors, others = tuples.descriptors[:, :1], tuples.descriptors[:, 1:]
    apart_m = tuples.apart_m[:, 1:]
    label = jnp.where(apart_m < SAME_M, 1.0, nn.sigmoid((HALF_M - apart_m) / WIDTH_M))
    entropy = optax.sigmoid_binary_cross_entropy(_scores(variables, jnp.abs(anchors - others)), label)
    distance = descriptor_distance(jnp.broadcast_to(anchors, others.shape), others)
    contrast = label * distance**2 + (1 - label) * nn.relu(MARGIN - distance) ** 2
    return entropy.mean() + contrast.mean()


def compare(
    variables: Variables, queries: Float[Array, "q 288"], database: Float[Array, "n 288"]
) -> Float[Array, "q n"]:
    """Return the distances: one minus the probability that two descriptors show one place."""
    return jax.lax.map(lambda query: 1 - nn.sigmoid(_scores(variables, jnp.abs(query[None] - database))), queries)


def _scores(variables: Variables, difference: Float[Array, "*b 288"]) -> Float[Array, "*b"]:
    return jnp.asarray(Score().apply({"params": variables["params"]["score"]}, difference))


RINET = LearnedMethod(
    name="rinet",
    source='Li et al., "RINet: Efficient 3D Lidar-Based Place Recognition Using Rotation Invariant Neural Network", '
    "RA-L 2022",
    licence="MIT",
    takes="labelled points",
    weights=98_765,
    network=RINet(),
    prepare=ring_image,
    rotate_inputs=rotate_with_lost_columns,
    loss=loss,
    compare=compare,
    recipe=Recipe(
        TupleConfig(positives=1, negatives=1, positive_m=LIMIT_M, negative_m=LIMIT_M),
        tuples=512,
        learning_rates=(0.002, 0.02, 0.06),
        weight_decay=1e-6,
    ),
)
