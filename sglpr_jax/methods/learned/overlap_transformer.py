"""OverlapTransformer (Ma et al., 2022), rebuilt from the paper: attention between the columns of a range image.

Published recipe: Adam 5e-6, times 0.9 every 5 epochs; sum over negatives of [0.5 + d_positive - d_negative]_+ with d =
L2 squared; 1 tuple of 6 positives (overlap above 0.3) and 6 negatives, 100 epochs of KITTI. Differences: 2 tuples a
step, a constant learning rate, and distances instead of overlaps decide which places are positives.
"""

import functools

import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Float32

from sglpr_jax.data.scan import Scan
from sglpr_jax.methods.cells import extreme_of_cells, polar
from sglpr_jax.methods.learned.layers import HE, NetVLAD
from sglpr_jax.methods.learned.method import LearnedMethod, finite_points, roll_azimuths, triplet
from sglpr_jax.methods.recipe import Recipe, TupleConfig
from sglpr_jax.models.convolution import stack_under_kernel
from sglpr_jax.models.layers import l2_normalize

ROWS, COLUMNS = 64, 900
HIGHEST_DEG, LOWEST_DEG = 15.0, -25.0
"""Elevations of the upper border of row 0 and of the lower border of row 63."""
FARTHEST_M = 80.0
"""Distance at which the range image is 1. Points farther away are dropped."""
CONVOLUTIONS = ((4, 2, 16), (4, 2, 32), (4, 2, 64), (4, 2, 128), (2, 1, 256))
"""Kernel height, stride and channels of each convolution along the rows. The rows become 31, 14, 6, 2 and 1."""
CHANNELS, HEADS, HIDDEN, CLUSTERS = 256, 4, 1024, 64
"""Outputs of the last convolution and of NetVLAD, heads and hidden units of the transformer, clusters of NetVLAD."""
MARGIN = 0.5


def range_image(scan: Scan) -> Float32[np.ndarray, "64 900"]:
    """Return the distance of the nearest point of each pixel, divided by 80 m. Pixels without points are 0.

    Rows are elevations from 15 degrees down to -25 degrees, which have all beams of HDL-64E and VLP-16, and all but the
    lowest beams of HDL-32E. Points at other elevations are dropped. Columns are azimuths, counter-clockwise from x.
    Raises ValueError if the scan shows no place (`check_cloud`).
    """
    points = finite_points(scan)
    radius, angle, z = polar(points)
    distance = np.sqrt(np.sum(points.astype(np.float64) ** 2, axis=1))
    row = np.floor((HIGHEST_DEG - np.degrees(np.arctan2(z, radius))) * (ROWS / (HIGHEST_DEG - LOWEST_DEG)))
    inside = (distance > 0) & (distance <= FARTHEST_M) & (row >= 0) & (row < ROWS)
    column = np.floor(angle % (2 * np.pi) * (COLUMNS / (2 * np.pi))) % COLUMNS
    pixels = (row[inside].astype(np.int64), column[inside].astype(np.int64))
    return extreme_of_cells(np.minimum, (ROWS, COLUMNS), pixels, distance[inside] / FARTHEST_M).astype(np.float32)


class OverlapTransformer(nn.Module):
    """Convolutions along the rows, one transformer layer between the columns, and NetVLAD: 256 numbers of unit length.

    No layer knows the position of a column, so a rotation by whole columns (0.4 degrees) does not change the
    descriptor. The heights of the kernels, the normalisations and the context gating are choices of this project. The
    paper gives the order of the layers and the sizes of the transformer and of NetVLAD.
    """

    @nn.compact
    def __call__(self, images: Float[Array, "b 64 900"], *, train: bool = False) -> Float[Array, "b 256"]:
        x = images[..., None]
        for height, stride, features in CONVOLUTIONS:
            rows = stack_under_kernel(x, 1, height, stride)  # a linear layer then acts as the convolution
            x = nn.relu(dense(features, rows))
        columns = nn.relu(dense(CHANNELS, x[:, 0]))
        columns = jnp.concatenate([columns, Transformer()(columns)], axis=-1)
        vlad = NetVLAD(CLUSTERS)(l2_normalize(columns))
        y = nn.Dense(CHANNELS)(vlad)
        return l2_normalize(y * nn.sigmoid(nn.Dense(CHANNELS)(y)))


class Transformer(nn.Module):
    """Transformer layer without positions: self-attention and a hidden layer, each with shortcut and layer norm."""

    @nn.compact
    def __call__(self, x: Float[Array, "b n c"]) -> Float[Array, "b n c"]:
        x = nn.LayerNorm()(x + nn.MultiHeadDotProductAttention(HEADS)(x))
        return nn.LayerNorm()(x + dense(x.shape[-1], nn.relu(dense(HIDDEN, x))))


def dense(features: int, x: Float[Array, "*b c"]) -> Float[Array, "*b {features}"]:
    """Apply a linear layer of the calling module as one product of two matrices, which is faster on a CPU."""
    y = nn.Dense(features, kernel_init=HE)(x.reshape(-1, x.shape[-1]))
    return y.reshape(*x.shape[:-1], features)


OVERLAP_TRANSFORMER = LearnedMethod(
    name="overlap-transformer",
    source='Ma et al., "OverlapTransformer", RA-L 2022, rebuilt from the paper',
    licence="GPL-3.0, not read",
    takes="points",
    weights=9_484_848,
    network=OverlapTransformer(),
    prepare=range_image,
    rotate_inputs=roll_azimuths,
    loss=functools.partial(triplet, squared=True, margin=MARGIN, closest_positive=False, reduction="sum"),
    recipe=Recipe(TupleConfig(positives=6, negatives=6), tuples=2, learning_rates=(2e-6, 5e-6, 1e-4)),
)
