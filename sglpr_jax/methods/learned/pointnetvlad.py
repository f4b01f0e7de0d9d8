"""PointNetVLAD (Uy and Lee, 2018): features of points, pooled by NetVLAD, as in its authors' TensorFlow code.

Published recipe: Adam 5e-5, times 0.9 every 5 epochs, at least 1e-5; lazy quadruplet with margins 0.5 and 0.2 on
squared L2. Batches of 2 tuples with 2 positives within 10 m, 18 negatives beyond 50 m and 1 other negative; 20
epochs; hard negatives from epoch 6; no rotations. Differences: a constant learning rate, 8 negatives, because a step
of 22 scans needs 4 GB, no mining, rotated scans, and one scan instead of a submap of 20 m.
"""

import functools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Float32

from sglpr_jax.data.scan import Scan
from sglpr_jax.methods.cells import voxel_means
from sglpr_jax.methods.learned.layers import batch_norm
from sglpr_jax.methods.learned.method import LearnedMethod, finite_points, quadruplet, rotate_clouds
from sglpr_jax.methods.recipe import Recipe, TupleConfig
from sglpr_jax.models.layers import l2_normalize, maximum
from sglpr_jax.models.netvlad import residual_sums

POINTS = 4096
RANGE_M = 40.0
"""Points farther than this distance, in metres, are dropped. Coordinates are divided by it."""
GROUND_M = -1.4
"""Points at or below this height above the sensor count as ground, in metres. The ground is at -1.73 m."""
VOXEL_M = 0.4
"""Side of the voxels whose means replace the points, as in the authors' submaps."""
CLUSTERS = 64
DESCRIPTOR_SIZE = 256
EPSILON = 1e-3
"""TensorFlow's epsilon of batch normalisation."""


class Mlp(nn.Module):
    """Linear layers with ReLU, applied to every row."""

    widths: Sequence[int]
    normalised: bool = False
    """Whether each layer has batch normalisation before ReLU."""

    @nn.compact
    def __call__(self, rows: Float[Array, "n c"], *, train: bool) -> Float[Array, "n _"]:
        for width in self.widths:
            rows = nn.Dense(width, kernel_init=nn.initializers.glorot_uniform())(rows)
            if self.normalised:
                rows = batch_norm(train, epsilon=EPSILON)(rows)
            rows = nn.relu(rows)
        return rows


class TNet(nn.Module):
    """Predicts a matrix from all points of a scan and multiplies each point by it. It starts as the unit matrix."""

    @nn.compact
    def __call__(self, points: Float[Array, "b n c"], *, train: bool) -> Float[Array, "b n c"]:
        b, n, c = points.shape
        features = Mlp((64, 128, 1024), normalised=True)(points.reshape(b * n, c), train=train)
        scan_features = maximum(features.reshape(b, n, -1), (1,))
        scan_features = Mlp((512, 256), normalised=True)(scan_features, train=train)
        matrix = nn.Dense(c * c, kernel_init=nn.initializers.zeros)(scan_features).reshape(b, c, c)
        return points @ (matrix + jnp.eye(c)[None])


class Vlad(nn.Module):
    """NetVLAD with batch normalisation and context gating.

    a[n, k] = softmax over k of BN(x W);  v = residual_sums(x, a, centres), L2-normalised

    y = BN(v H);  output = y * sigmoid(BN(y G))
    """

    @nn.compact
    def __call__(self, features: Float[Array, "b n d"], *, train: bool) -> Float[Array, "b 256"]:
        b, n, d = features.shape
        init = nn.initializers.normal(d**-0.5)
        logits = nn.Dense(CLUSTERS, use_bias=False, kernel_init=init, name="clusters")(features.reshape(b * n, d))
        assignment = nn.softmax(batch_norm(train, epsilon=EPSILON)(logits)).reshape(b, n, CLUSTERS)
        centres = self.param("centres", init, (d, CLUSTERS))
        vlad = l2_normalize(residual_sums(features, assignment, centres).reshape(b, -1))
        hidden = nn.Dense(
            DESCRIPTOR_SIZE, use_bias=False, kernel_init=nn.initializers.normal(CLUSTERS**-0.5), name="hidden"
        )
        y = batch_norm(train, epsilon=EPSILON)(hidden(vlad))
        gate = nn.Dense(
            DESCRIPTOR_SIZE, use_bias=False, kernel_init=nn.initializers.normal(DESCRIPTOR_SIZE**-0.5), name="gate"
        )
        return y * nn.sigmoid(batch_norm(train, epsilon=EPSILON)(gate(y)))


class PointNetVlad(nn.Module):
    """PointNet without its last pooling, and NetVLAD: 256 numbers of unit length. The order of points has no effect."""

    @nn.compact
    def __call__(self, points: Float[Array, "b n 3"], *, train: bool = False) -> Float[Array, "b 256"]:
        b, n, _ = points.shape
        transformed = TNet()(points, train=train)
        features = Mlp((64, 64))(transformed.reshape(b * n, 3), train=train)
        transformed = TNet()(features.reshape(b, n, -1), train=train)
        features = Mlp((64, 128, 1024))(transformed.reshape(b * n, -1), train=train)
        return l2_normalize(Vlad()(l2_normalize(features).reshape(b, n, -1), train=train))


def scaled_points(scan: Scan) -> Float32[np.ndarray, "4096 3"]:
    """Return 4096 points above the ground within 40 m, divided by 40 m, so that coordinates are between -1 and 1.

    The points are means of voxels of 0.4 m, drawn without replacement with the same seed for every scan. If a scan has
    fewer voxels, some are drawn again. Raises ValueError if it has no such points, or shows no place (`check_cloud`).
    """
    points = finite_points(scan)
    points_in_range = points[(points[:, 2] > GROUND_M) & (np.linalg.norm(points, axis=1) < RANGE_M)]
    if len(points_in_range) == 0:
        expected = f"points within {RANGE_M:g} m and above {GROUND_M:g} m"
        raise ValueError(f"{scan.name}: expected {expected}, found none of {len(points)}")
    means = voxel_means(points_in_range, VOXEL_M)
    rng = np.random.default_rng(0)
    if len(means) >= POINTS:
        rows = rng.choice(len(means), POINTS, replace=False)
    else:
        rows = np.concatenate([np.arange(len(means)), rng.choice(len(means), POINTS - len(means))])
    return (means[rows] / RANGE_M).astype(np.float32)


POINTNETVLAD = LearnedMethod(
    name="pointnetvlad",
    source='Uy and Lee, "PointNetVLAD", CVPR 2018, TensorFlow form',
    licence="MIT",
    takes="points",
    weights=19_784_393,
    network=PointNetVlad(),
    prepare=scaled_points,
    rotate_inputs=rotate_clouds,
    loss=functools.partial(quadruplet, closest_positive=True),
    recipe=Recipe(
        TupleConfig(positives=2, negatives=8, positive_m=10.0, negative_m=50.0),
        tuples=2,
        learning_rates=(1.5e-5, 5e-5, 1.5e-4),
    ),
)
