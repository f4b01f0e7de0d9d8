"""SGPR (Kong et al., 2020): a network on the semantic graph of a scan, with a learned comparison of two graphs.

Published recipe: Adam 1e-3 with weight decay 5e-4; binary cross-entropy of 128 pairs in both orders; positives within 3
m, negatives beyond 20 m; 500 epochs. Differences: the pairs are those of an anchor with the places of its tuple, and
graphs are only rotated.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Float32, Int

from sglpr_jax.data.scan import Scan, check_cloud
from sglpr_jax.data.views import classes_of
from sglpr_jax.methods.cells import group_by_voxel, group_means
from sglpr_jax.methods.learned.layers import batch_norm
from sglpr_jax.methods.learned.method import LearnedMethod, Tuples, Variables, rotate_clouds
from sglpr_jax.methods.recipe import Recipe, TupleConfig
from sglpr_jax.models.layers import maximum

NEIGHBOURS = 10
WIDTHS = (64, 64, 32)
"""Channels of the three layers of EdgeConv. The last is the length of a descriptor."""
BILINEAR_FORMS = 16
"""Number of bilinear forms that compare two graphs."""
TIE_BREAKER = 1e-4
"""Weight of the distance in space, per metre, that orders nodes with equally near classes."""
NODES = 100
CLUSTER_RULES = {
    1: (0.5, 100),  # car
    4: (0.5, 100),  # truck
    5: (0.5, 100),  # other vehicle
    11: (2.0, 300),  # sidewalk
    12: (2.0, 300),  # other ground
    13: (2.0, 300),  # building
    14: (0.5, 100),  # fence
    15: (2.0, 200),  # vegetation
    16: (0.2, 50),  # trunk
    17: (2.0, 300),  # terrain
    18: (0.2, 100),  # pole
    19: (0.2, 50),  # traffic sign
}
"""For each class that is used, the maximum gap in a cluster, in metres, and the minimum number of its points."""
MAX_POINTS = 50_000
"""Maximum number of points of a cluster. Larger clusters are dropped."""
VOXELS_PER_GAP = 4
"""Points are first merged into voxels whose side is the gap divided by this number."""


def semantic_graph(scan: Scan) -> Float32[np.ndarray, "100 15"]:
    """Return 100 nodes of a graph: each is x, y, z of the centre of a cluster, in metres, and its one-hot class.

    Missing nodes are zeros. Of more than 100 clusters, those with the most points remain; the published graph has 100
    random ones, and takes clusters from the instances of SemanticKITTI if a scan has them. Raises ValueError if the
    scan shows no place (`check_cloud`), or has no labels or no cluster.
    """
    points, classes = scan.upright_points, classes_of(scan, 20)
    check_cloud(points, name=scan.name)
    is_finite = np.isfinite(points).all(axis=1)
    points, classes = points[is_finite], classes[is_finite]
    sizes, nodes = [], []
    one_hot_classes = np.eye(len(CLUSTER_RULES))
    for i, (class_number, (gap_m, min_points)) in enumerate(CLUSTER_RULES.items()):
        class_points = points[classes == class_number]
        cluster = cluster_of_points(class_points, gap_m)
        counts = np.bincount(cluster)
        is_valid = (counts >= min_points) & (counts <= MAX_POINTS)
        centres = group_means(class_points, cluster, counts)[is_valid]
        sizes.append(counts[is_valid])
        nodes.append(np.concatenate([centres, np.repeat(one_hot_classes[i : i + 1], len(centres), axis=0)], axis=1))
    largest = np.sort(np.argsort(-np.concatenate(sizes), kind="stable")[:NODES])
    if len(largest) == 0:
        expected = f"clusters of {len(CLUSTER_RULES)} classes"
        raise ValueError(f"{scan.name}: expected {expected}, found none in {len(points)} points")
    graph = np.concatenate(nodes)[largest].astype(np.float32)
    return np.pad(graph, ((0, NODES - len(largest)), (0, 0)))


def cluster_of_points(points: Float[np.ndarray, "n 3"], gap_m: float) -> Int[np.ndarray, " n"]:
    """Return the index of each point's cluster. Neighbouring voxel means in a cluster are at most `gap_m` apart."""
    # imported here because the imports are slow
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    if len(points) == 0:
        return np.zeros(0, np.int64)
    voxel, counts = group_by_voxel(points, gap_m / VOXELS_PER_GAP)
    pairs = KDTree(group_means(points, voxel, counts)).query_pairs(gap_m, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(counts), len(counts)))
    _, cluster_of_voxel = connected_components(links, directed=False)
    return cluster_of_voxel[voxel].astype(np.int64)


def nearest_nodes(squares: Float[Array, "b n n"]) -> Int[Array, "b n 10"]:
    """Return the indices of the 10 nearest nodes of each node, including itself, given all squared distances."""
    return jax.lax.top_k(-squares, NEIGHBOURS)[1]


def squared_distances(x: Float[Array, "b n c"]) -> Float[Array, "b n n"]:
    """Return the squared distances between all pairs of the n nodes of each graph."""
    square = jnp.square(x).sum(-1)
    return square[:, :, None] + square[:, None, :] - 2 * x @ x.swapaxes(1, 2)


class EdgeConv(nn.Module):
    """Maximum over the neighbours j of LeakyReLU(BN(A x_j + (B - A) x_i)), where [A, B] act on [x_j - x_i, x_i]."""

    features: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "b n c"], neighbours: Int[Array, "b n 10"], *, train: bool
    ) -> Float[Array, "b n {self.features}"]:
        neighbour_part = nn.Dense(self.features, use_bias=False, name="relative")(x)
        node_part = nn.Dense(self.features, use_bias=False, name="own")(x) - neighbour_part
        edges = jax.vmap(lambda parts, indices: parts[indices])(neighbour_part, neighbours) + node_part[:, :, None]
        return maximum(nn.leaky_relu(batch_norm(train)(edges), 0.2), (2,))


class GraphAttention(nn.Module):
    """Sum of the nodes x_i, weighted by sigmoid(x_i . tanh(mean of W x))."""

    @nn.compact
    def __call__(self, x: Float[Array, "b n c"]) -> Float[Array, "b c"]:
        init = nn.initializers.glorot_uniform()
        context = nn.tanh(nn.Dense(x.shape[-1], use_bias=False, kernel_init=init)(x).mean(1))
        weights = nn.sigmoid((x * context[:, None]).sum(-1))
        return (x * weights[..., None]).sum(1)


class TensorNetwork(nn.Module):
    """Compares vectors a and b of two graphs by relu(a T_k b + V_k [a, b] + bias_k), k < 16, and two linear layers."""

    @nn.compact
    def __call__(self, queries: Float[Array, "q c"], others: Float[Array, "n c"]) -> Float[Array, "q n"]:
        """Return log(p / (1 - p)) of the probability p that two graphs show the same place, for all pairs."""
        c = queries.shape[1]
        init = nn.initializers.glorot_uniform()
        tensor = self.param("tensor", init, (c, c, BILINEAR_FORMS))
        linear = self.param("linear", init, (2 * c, BILINEAR_FORMS))
        bias = self.param("bias", init, (BILINEAR_FORMS, 1))[:, 0]
        bilinear_part = jnp.einsum("qc,cdk,nd->qnk", queries, tensor, others)
        linear_part = (queries @ linear[:c])[:, None] + (others @ linear[c:])[None]
        hidden = nn.relu(nn.Dense(16, name="hidden")(nn.relu(bilinear_part + linear_part + bias[None, None])))
        return nn.Dense(1, name="score")(hidden)[..., 0]


class Sgpr(nn.Module):
    """Three layers of EdgeConv on the positions and three on the classes of nodes, then attention: 32 numbers.

    The neighbours of a layer are the nearest nodes by the layer's input. Missing nodes take part like others. Among
    equal classes, nodes that are nearer in space come first; the published choice depends on the order of the nodes.
    """

    def setup(self):
        self.space = [EdgeConv(width) for width in WIDTHS]
        self.kinds = [EdgeConv(width) for width in WIDTHS]
        self.joint = nn.Dense(WIDTHS[-1], use_bias=False)
        self.norm = nn.BatchNorm(momentum=0.9, epsilon=1e-5)
        self.attention = GraphAttention()
        self.comparison = TensorNetwork()

    def __call__(self, graphs: Float[Array, "b n 15"], *, train: bool = False) -> Float[Array, "b 32"]:
        """Return a vector of each graph, whose nodes have x, y, z in metres and a one-hot class (12 numbers)."""
        space, kinds = graphs[..., :3], graphs[..., 3:]
        ties = TIE_BREAKER * jnp.sqrt(jnp.maximum(squared_distances(space), 0))
        for depth, (space_layer, kind_layer) in enumerate(zip(self.space, self.kinds, strict=True)):
            space = space_layer(space, nearest_nodes(squared_distances(space)), train=train)
            kind_distances = squared_distances(kinds) + (ties if depth == 0 else 0)
            kinds = kind_layer(kinds, nearest_nodes(kind_distances), train=train)
        joint = self.joint(jnp.concatenate([space, kinds], axis=-1))
        vectors = self.attention(nn.leaky_relu(self.norm(joint, use_running_average=not train), 0.2))
        if self.is_initializing():
            self.comparison(vectors, vectors)  # creates its weights
        return vectors

    def logits(self, queries: Float[Array, "q 32"], others: Float[Array, "n 32"]) -> Float[Array, "q n"]:
        """Return log(p / (1 - p)) of all pairs, as `TensorNetwork`."""
        return self.comparison(queries, others)


NETWORK = Sgpr()


def _logits(variables: Variables, queries: Float[Array, "q 32"], others: Float[Array, "n 32"]) -> Float[Array, "q n"]:
    return jnp.asarray(NETWORK.apply({"params": variables["params"]}, queries, others, method="logits"))


@jax.jit
def compare(variables: Variables, queries: Float[Array, "q 32"], database: Float[Array, "n 32"]) -> Float[Array, "q n"]:
    """Return the distances -log(p), where p is the probability that two graphs show the same place.

    The published score is p. Its negative logarithm has the same order, and distinguishes pairs whose p rounds to 1.
    The query is the first graph of a pair, which is not symmetric.
    """
    return jax.lax.map(lambda query: nn.softplus(-_logits(variables, query[None], database)[0]), queries)


def loss(variables: Variables, tuples: Tuples) -> Float[Array, ""]:
    """Return the mean binary cross-entropy of each anchor with its positives (1) and negatives (0), in both orders."""

    def tuple_loss(vectors: Float[Array, "k d"]) -> Float[Array, ""]:
        anchor, others = vectors[:1], vectors[1:]
        is_positive = jnp.arange(len(others)) < tuples.positives
        logits_anchor_first = _logits(variables, anchor, others)[0]
        logits_anchor_second = _logits(variables, others, anchor)[:, 0]
        logits = jnp.stack([logits_anchor_first, logits_anchor_second])
        return nn.softplus(jnp.where(is_positive[None], -logits, logits)).mean()

    return jax.vmap(tuple_loss)(tuples.descriptors).mean()


SGPR = LearnedMethod(
    name="sgpr",
    source='Kong et al., "Semantic Graph Based Place Recognition for 3D Point Clouds", IROS 2020',
    licence="MIT",
    takes="labelled points",
    weights=47_985,
    network=NETWORK,
    prepare=semantic_graph,
    rotate_inputs=rotate_clouds,
    loss=loss,
    recipe=Recipe(
        TupleConfig(positives=1, negatives=3, positive_m=3.0, negative_m=20.0),
        tuples=32,
        learning_rates=(3e-4, 1e-3, 3e-3),
        weight_decay=5e-4,
    ),
    compare=compare,
)
