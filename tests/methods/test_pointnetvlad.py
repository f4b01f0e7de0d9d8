"""PointNetVLAD: the network and its loss against numpy, its input, and the order of points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.data.recording import Record
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.learned.method import Tuples
from sglpr_jax.methods.learned.pointnetvlad import POINTNETVLAD, TNet, scaled_points, turned
from sglpr_jax.methods.voxel_means import voxel_means


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(1).uniform(-1, 1, (3, 40, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def start(points):
    """Variables as initialised."""
    return jax.jit(POINTNETVLAD.network.init)(jax.random.key(0), points)


@pytest.fixture(scope="module")
def variables(start):
    """Variables as after some training: no layer is zero, and the statistics are not those of the start."""
    rng = np.random.default_rng(2)

    def moved(path, leaf):
        scale = 0.3 if leaf.ndim == 1 else leaf.shape[0] ** -0.5
        noise = scale * rng.standard_normal(leaf.shape, np.float32)
        return np.abs(leaf + noise) + 0.1 if path[-1].key == "var" else leaf + noise

    return jax.tree_util.tree_map_with_path(moved, start)


@pytest.fixture(scope="module")
def found(variables, points):
    return np.asarray(jax.jit(POINTNETVLAD.network.apply)(variables, points))


class Reference:
    """The network in numpy, one scan at a time, with the layers in the order of their names."""

    def __init__(self, variables):
        self.params, self.stats = (jax.tree.map(np.float64, variables[kind]) for kind in ("params", "batch_stats"))

    def norm(self, x, *path):
        weights, stats = self.params, self.stats
        for name in path:
            weights, stats = weights[name], stats[name]
        return (x - stats["mean"]) / np.sqrt(stats["var"] + 1e-3) * weights["scale"] + weights["bias"]

    def mlp(self, x, *path, normalised=False):
        weights = self.params
        for name in path:
            weights = weights[name]
        for i in range(sum(name.startswith("Dense") for name in weights)):
            x = x @ weights[f"Dense_{i}"]["kernel"] + weights[f"Dense_{i}"]["bias"]
            x = self.norm(x, *path, f"BatchNorm_{i}") if normalised else x
            x = np.maximum(x, 0)
        return x

    def transformed(self, x, name):
        features = self.mlp(x, name, "Mlp_0", normalised=True).max(axis=0)
        whole = self.mlp(features, name, "Mlp_1", normalised=True)
        last = self.params[name]["Dense_0"]
        size = x.shape[1]
        return x @ ((whole @ last["kernel"] + last["bias"]).reshape(size, size) + np.eye(size))

    def vlad(self, x):
        weights = self.params["Vlad_0"]
        logits = self.norm(x @ weights["clusters"]["kernel"], "Vlad_0", "BatchNorm_0")
        share = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
        pooled = np.zeros((1024, 64))
        for n in range(len(x)):
            for k in range(64):
                pooled[:, k] += share[n, k] * (x[n] - weights["centres"][:, k])
        pooled /= np.linalg.norm(pooled, axis=0)
        pooled = pooled.ravel() / np.linalg.norm(pooled)
        y = self.norm(pooled @ weights["hidden"]["kernel"], "Vlad_0", "BatchNorm_1")
        gate = self.norm(y @ weights["gate"]["kernel"], "Vlad_0", "BatchNorm_2")
        return y / (1 + np.exp(-gate))

    def __call__(self, scan):
        features = self.mlp(self.transformed(scan.astype(np.float64), "TNet_0"), "Mlp_0")
        features = self.mlp(self.transformed(features, "TNet_1"), "Mlp_1")
        y = self.vlad(features / np.linalg.norm(features, axis=1, keepdims=True))
        return y / np.linalg.norm(y)


def test_the_method_is_registered_and_has_the_published_number_of_weights(start):
    assert LEARNED["pointnetvlad"] is POINTNETVLAD
    assert sum(leaf.size for leaf in jax.tree.leaves(start["params"])) == POINTNETVLAD.weights == 19_784_393


def test_the_descriptor_is_the_published_one(variables, points, found):
    expected = np.stack([Reference(variables)(scan) for scan in points])
    np.testing.assert_allclose(found, expected, atol=2e-5)
    assert np.abs(expected[0] - expected[1]).max() > 0.003


def test_the_order_of_the_points_does_not_matter(variables, points, found):
    order = np.random.default_rng(0).permutation(points.shape[1])
    again = jax.jit(POINTNETVLAD.network.apply)(variables, points[:, order])
    np.testing.assert_allclose(again, found, atol=1e-5)


def test_the_learned_transformation_starts_as_the_identity(points):
    moved, _ = TNet().init_with_output(jax.random.key(0), jnp.asarray(points), train=False)
    np.testing.assert_array_equal(moved, points)


@pytest.mark.slow
def test_every_weight_learns(variables, points):
    def of(params):
        rows, _ = POINTNETVLAD.network.apply(
            variables | {"params": params}, jnp.asarray(points), train=True, mutable=["batch_stats"]
        )
        return rows[0] @ rows[1]

    for path, slope in jax.tree_util.tree_leaves_with_path(jax.jit(jax.grad(of))(variables["params"])):
        assert np.isfinite(slope).all() and np.abs(slope).max() > 0, path


def loss_in_loops(rows, positives):
    total = 0.0
    for t, (anchor, *others) in enumerate(rows):
        near = min(np.sum((anchor - other) ** 2) for other in others[:positives])
        negatives = others[positives:]
        total += max(max(0.5 + near - np.sum((anchor - n) ** 2), 0) for n in negatives)
        if len(rows) > 1:
            stranger = rows[(t + 1) % len(rows)][0]
            total += max(max(0.2 + near - np.sum((stranger - n) ** 2), 0) for n in negatives)
    return total / len(rows)


@pytest.mark.parametrize(("tuples", "positives"), [(1, 1), (2, 2), (3, 1)])
def test_the_loss_is_the_lazy_quadruplet(tuples, positives):
    rows = 0.15 * np.random.default_rng(tuples).normal(size=(tuples, 6, 8)).astype(np.float32)
    apart = jnp.zeros((tuples, 6))
    found = POINTNETVLAD.loss({}, Tuples(jnp.asarray(rows), apart, positives))
    assert found > 0 and found == pytest.approx(loss_in_loops(rows.astype(float), positives), rel=1e-5)


def test_equal_descriptors_have_a_finite_gradient():
    slope = jax.grad(lambda rows: POINTNETVLAD.loss({}, Tuples(rows, jnp.zeros((2, 4)), 1)))(jnp.ones((2, 4, 8)))
    assert np.isfinite(slope).all()


def record(points, name="scan 7"):
    return Record(points=np.asarray(points, np.float32), name=name)


def test_inputs_are_voxel_means_above_the_ground(places):
    rng = np.random.default_rng(0)
    many = np.column_stack([rng.uniform(-45, 45, (30000, 2)), rng.uniform(-1.7, 20, 30000)]).astype(np.float32)
    found = scaled_points(record(many))
    near = many[(many[:, 2] > -1.4) & (np.linalg.norm(many, axis=1) < 40)]
    means = {tuple(row) for row in (voxel_means(near, 0.4) / 40).astype(np.float32)}
    assert found.shape == (4096, 3) and found.dtype == np.float32 and np.abs(found).max() <= 1
    assert {tuple(row) for row in found} <= means and len({tuple(row) for row in found}) == 4096


def test_few_points_are_all_used_again(places):
    found = scaled_points(record(places[0][0]))
    near = places[0][0][(places[0][0][:, 2] > -1.4) & (np.linalg.norm(places[0][0], axis=1) < 40)]
    means = {tuple(row) for row in (voxel_means(near, 0.4) / 40).astype(np.float32)}
    assert len(found) == 4096 > len(means) and {tuple(row) for row in found} == means


def test_points_that_are_not_finite_are_ignored(places):
    broken = np.concatenate([places[0][0], [[np.nan, 1, 1], [np.inf, 2, 2]]])
    np.testing.assert_array_equal(scaled_points(record(broken)), scaled_points(record(places[0][0])))


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([[5, 0, -1.7], [6, 0, -1.6]], "scan 7: expected points within 40 m"),
        ([[np.nan] * 3], "scan 7: expected finite"),
    ],
)
def test_a_scan_without_a_place_is_named(points, words):
    with pytest.raises(ValueError, match=words):
        scaled_points(record(points))


def test_each_input_turns_by_its_own_angle(points):
    found = np.asarray(turned(jax.random.key(3), jnp.asarray(points)))
    np.testing.assert_array_equal(found[..., 2], points[..., 2])
    before, after = (scans[..., 0] + 1j * scans[..., 1] for scans in (points, found))
    angles = np.angle(after / before)
    np.testing.assert_allclose(np.exp(1j * angles), np.exp(1j * angles[:, :1]) * np.ones((1, 40)), atol=1e-4)
    np.testing.assert_allclose(np.abs(after), np.abs(before), rtol=1e-5)
    assert len({round(float(angle), 3) for angle in angles[:, 0]}) == 3
