"""SGPR: the graph of a scan, the network, its comparison and its loss against numpy, and the order of nodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.data.recording import Record
from sglpr_jax.labels import to_raw
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.learned.method import Tuples
from sglpr_jax.methods.learned.sgpr import MOST_POINTS, SGPR, clusters, compare, loss, semantic_graph, turned


def graph(seed, nodes=100):
    """A graph of random nodes, most of them of few classes."""
    rng = np.random.default_rng(seed)
    found = np.zeros((100, 15), np.float32)
    found[:nodes, :3] = rng.normal(0, 20, (nodes, 3))
    found[np.arange(nodes), 3 + np.minimum(rng.integers(0, 40, nodes), 11)] = 1
    return found


@pytest.fixture(scope="module")
def graphs() -> np.ndarray:
    return np.stack([graph(0), graph(1, 60), graph(2, 7)])


@pytest.fixture(scope="module")
def start(graphs):
    return jax.jit(SGPR.network.init)(jax.random.key(0), graphs)


@pytest.fixture(scope="module")
def variables(start):
    """Variables as after some training: scales of both signs, and statistics that are not those of the start."""
    rng = np.random.default_rng(2)

    def moved(path, leaf):
        noise = 0.3 * rng.standard_normal(leaf.shape, np.float32)
        if path[-1].key == "var":
            return np.abs(leaf + noise) * (400 if path[-3].key == "space_0" else 1) + 0.1
        return rng.normal(size=leaf.shape).astype(np.float32) if path[-1].key == "scale" else leaf + noise

    return jax.tree_util.tree_map_with_path(moved, start)


@pytest.fixture(scope="module")
def found(variables, graphs):
    return np.asarray(jax.jit(SGPR.network.apply)(variables, graphs))


class Reference:
    """The network in numpy, node by node, as published: the kernels of both halves of an edge as one."""

    def __init__(self, variables):
        self.params, self.stats = (jax.tree.map(np.float64, variables[kind]) for kind in ("params", "batch_stats"))

    def leaky_norm(self, x, weights, stats):
        y = (x - stats["mean"]) / np.sqrt(stats["var"] + 1e-5) * weights["scale"] + weights["bias"]
        return np.where(y > 0, y, 0.2 * y)

    def edges(self, x, name, ties=None):
        weights, stats = self.params[name], self.stats[name]
        kernel = np.concatenate([weights["relative"]["kernel"], weights["own"]["kernel"]])
        rows = []
        for i in range(len(x)):
            apart = ((x - x[i]) ** 2).sum(axis=1)
            order = np.argsort(apart, kind="stable") if ties is None else np.lexsort((ties[i], apart.round(6)))
            pairs = [np.concatenate([x[j] - x[i], x[i]]) @ kernel for j in order[:10]]
            rows.append(self.leaky_norm(np.stack(pairs), weights["BatchNorm_0"], stats["BatchNorm_0"]).max(axis=0))
        return np.stack(rows)

    def __call__(self, nodes):
        space, kinds = nodes[:, :3].astype(np.float64), nodes[:, 3:].astype(np.float64)
        ties = np.linalg.norm(space[:, None] - space[None], axis=2)
        for depth in range(3):
            space = self.edges(space, f"space_{depth}")
            kinds = self.edges(kinds, f"kinds_{depth}", ties if depth == 0 else None)
        both = np.concatenate([space, kinds], axis=1) @ self.params["joint"]["kernel"]
        x = self.leaky_norm(both, self.params["norm"], self.stats["norm"])
        context = np.tanh((x @ self.params["attention"]["Dense_0"]["kernel"]).mean(axis=0))
        return sum(node / (1 + np.exp(-node @ context)) for node in x)

    def logit(self, a, b):
        weights = self.params["comparison"]
        forms = [a @ weights["tensor"][:, :, k] @ b for k in range(16)]
        hidden = np.array(forms) + weights["linear"].T @ np.concatenate([a, b]) + weights["bias"][:, 0]
        hidden = np.maximum(hidden, 0) @ weights["hidden"]["kernel"] + weights["hidden"]["bias"]
        return float(np.maximum(hidden, 0) @ weights["score"]["kernel"][:, 0] + weights["score"]["bias"][0])


def test_the_method_is_registered_and_has_the_published_number_of_weights(start):
    edges = sum(2 * c * f + 2 * f for c, f in ((3, 64), (12, 64), (64, 64), (64, 64), (64, 32), (64, 32)))
    joint, attention = 64 * 32 + 2 * 32, 32 * 32
    comparison = 32 * 32 * 16 + 64 * 16 + 16 + 16 * 16 + 16 + 16 + 1
    assert LEARNED["sgpr"] is SGPR and edges + joint + attention + comparison == SGPR.weights
    assert sum(leaf.size for leaf in jax.tree.leaves(start["params"])) == SGPR.weights == 47_985


def test_the_vector_is_the_published_one(variables, graphs, found):
    expected = np.stack([Reference(variables)(nodes) for nodes in graphs])
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())
    assert np.abs(expected[0] - expected[1]).max() > 0.1 * np.abs(expected).max()


def test_the_order_of_the_nodes_does_not_matter(variables, graphs, found):
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(100)
        again = jax.jit(SGPR.network.apply)(variables, graphs[:, order])
        np.testing.assert_allclose(again, found, rtol=1e-4, atol=1e-4 * np.abs(found).max())


def test_the_distance_is_the_negative_logarithm_of_the_score(variables, found):
    reference = Reference(variables)
    vectors = (found / np.abs(found).max()).astype(np.float32)
    expected = [[np.log1p(np.exp(-reference.logit(a, b))) for b in vectors] for a in vectors.astype(float)]
    np.testing.assert_allclose(compare(variables, vectors, vectors), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("positives", [1, 2])
def test_the_loss_is_the_cross_entropy_of_both_orders(variables, positives):
    reference = Reference(variables)
    rows = np.random.default_rng(0).normal(size=(2, 4, 32)).astype(np.float32)
    terms = []
    for anchor, *others in rows.astype(float):
        for i, other in enumerate(others):
            sign = -1 if i < positives else 1
            terms += [np.log1p(np.exp(sign * reference.logit(*pair))) for pair in ((anchor, other), (other, anchor))]
    found = loss(variables, Tuples(jnp.asarray(rows), jnp.zeros((2, 4)), positives))
    assert found == pytest.approx(np.mean(terms), rel=1e-4)


def test_training_reaches_every_weight(variables, graphs):
    def loss_of(params):
        everything = variables | {"params": params}
        rows, _ = SGPR.network.apply(everything, jnp.asarray(graphs), train=True, mutable=["batch_stats"])
        return loss(everything, Tuples(rows[None], jnp.zeros((1, 3)), 1))

    for path, slope in jax.tree_util.tree_leaves_with_path(jax.jit(jax.grad(loss_of))(variables["params"])):
        assert np.isfinite(slope).all() and np.abs(slope).max() > 0, path


def test_only_positions_turn(graphs):
    found = np.asarray(turned(jax.random.key(0), jnp.asarray(graphs)))
    np.testing.assert_array_equal(found[..., 2:], graphs[..., 2:])
    before, after = (nodes[0, :, 0] + 1j * nodes[0, :, 1] for nodes in (graphs, found))
    np.testing.assert_allclose(after / before, (after[0] / before[0]) * np.ones(100), rtol=1e-4)
    np.testing.assert_array_equal(found[2, 7:], 0)


def blob(centre, n, seed, spread=0.05):
    return np.random.default_rng(seed).uniform(-spread, spread, (n, 3)) + np.asarray(centre)


def record(*parts):
    """A scan of (points, class) parts."""
    points = np.concatenate([points for points, _ in parts]).astype(np.float32)
    classes = np.concatenate([np.full(len(points), category) for points, category in parts])
    return Record(points=points, labels=to_raw(classes).astype(np.int32), name="scan 7")


def test_nodes_are_the_centres_of_clusters_of_a_class():
    parts = [
        (blob((5, 0, 0), 120, 0), 1),
        (blob((8, 0, 0), 110, 1), 1),  # another car
        (blob((5, 0, 1), 60, 2), 16),  # a trunk at the place of the car
        (blob((9, 9, 0), 40, 3), 16),  # too few points
        (blob((1, 1, 0), 500, 4), 9),  # road has no nodes
    ]
    found = semantic_graph(record(*parts))
    assert found.shape == (100, 15) and found.dtype == np.float32 and not found[3:].any()
    expected = np.stack([points.mean(axis=0) for points, _ in parts[:3]])
    order = np.lexsort((found[:3, 0], -found[:3, 3]))
    np.testing.assert_allclose(found[:3][order][:, :3], expected, atol=1e-5)
    np.testing.assert_array_equal(found[:3, 3:].argmax(axis=1)[order], [0, 0, 8])
    np.testing.assert_array_equal(found[:3, 3:].sum(axis=1), 1)


def test_the_largest_hundred_clusters_remain():
    parts = [(blob((2 * i, 0, 0), 100 + i, i), 18) for i in range(110)]
    found = semantic_graph(record(*parts))
    np.testing.assert_allclose(np.sort(found[:, 0]), 2.0 * np.arange(10, 110), atol=0.05)


def test_clusters_link_points_within_the_gap():
    rng = np.random.default_rng(0)
    for gap in (0.5, 2.0):
        points = rng.uniform(-12, 12, (200, 3)) * [1, 1, 0.1]
        linked = np.linalg.norm(points[:, None] - points[None], axis=2) <= gap
        for _ in range(8):
            linked = linked @ linked
        np.testing.assert_array_equal(linked, np.equal.outer(*[clusters(points, gap)] * 2))


def test_huge_clusters_are_dropped():
    huge = (blob((5, 0, 0), MOST_POINTS + 1, 0, spread=0.4), 13)
    found = semantic_graph(record(huge, (blob((20, 0, 0), 60, 1), 16)))
    assert found[:, 3:].sum() == 1 and found[0, 3 + 8] == 1


def test_points_that_are_not_finite_are_ignored():
    car = (blob((5, 0, 0), 120, 0), 1)
    broken = (np.array([[np.nan, 0, 0], [np.inf, 0, 0]]), 1)
    np.testing.assert_array_equal(semantic_graph(record(car, broken)), semantic_graph(record(car)))


@pytest.mark.parametrize(
    ("scan", "words"),
    [
        (Record(points=np.ones((9, 3), np.float32), name="scan 7"), "scan 7: expected labels, found none"),
        (record((blob((5, 0, 0), 500, 0), 9)), "scan 7: expected clusters of 12 classes, found none in 500 points"),
        (record((np.full((9, 3), np.nan), 1)), "scan 7: expected finite points"),
    ],
)
def test_a_scan_without_a_graph_is_named(scan, words):
    with pytest.raises(ValueError, match=words):
        semantic_graph(scan)
