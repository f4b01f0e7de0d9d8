"""Every network of another publication: input, layers, invariance, loss and distance, against numpy."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.data.density_image import density_bev
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.scan import Scan
from sglpr_jax.labels import to_raw
from sglpr_jax.methods import registry
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.learned.bevplace import grey_image
from sglpr_jax.methods.learned.method import Tuples
from sglpr_jax.methods.learned.sgpr import cluster_of_points
from sglpr_jax.methods.learned.trained import describe_inputs, learned_distance, random_variables
from sglpr_jax.methods.names import LEARNED_NAMES

from . import learned_reference as reference

NAMES = [name for name in LEARNED if name != "resnet34-netvlad"]  # it has the weights of bevplace++
ON_POINTS = [name for name in NAMES if LEARNED[name].takes != "images"]
INPUTS = {
    "disco": reference.occupancy,
    "overlap-transformer": reference.range_image,
    "rinet": reference.ring_image,
}
NETWORKS = {
    "disco": reference.disco,
    "overlap-transformer": reference.overlap_transformer,
    "pointnetvlad": reference.pointnetvlad,
    "sgpr": reference.sgpr,
}
LOGITS = {"rinet": reference.rinet_logit, "sgpr": reference.sgpr_logit}
SAME = {  # a change of one input that does not change the descriptor
    "rinet": lambda x: np.roll(x, 7, axis=1),
    "bevplace++": lambda x: np.rot90(x),
    "disco": lambda x: np.roll(x, 56, axis=1),
    "overlap-transformer": lambda x: np.roll(x, 17, axis=1),
    "pointnetvlad": lambda x: np.random.default_rng(0).permutation(x),
    "sgpr": lambda x: np.random.default_rng(0).permutation(x),
}
KEPT = {  # what a rotation of one input for the training does not change
    "bevplace++": lambda x: [],
    "disco": lambda x: [x.sum(1)],
    "overlap-transformer": lambda x: [x.sum(1)],
    "pointnetvlad": lambda x: [np.hypot(x[:, 0], x[:, 1]), x[:, 2]],
    "sgpr": lambda x: [np.hypot(x[:, 0], x[:, 1]), *x[:, 2:].T],
    "rinet": lambda x: [],
}


def scan(points, classes=None, name="scan 7"):
    labels = None if classes is None else to_raw(np.asarray(classes)).astype(np.int32)
    return Scan(points=np.asarray(points, np.float32), labels=labels, name=name)


@pytest.fixture(scope="module")
def inputs(places):
    """Return a function from the name of a method to inputs of three places, small where the network allows it."""

    @functools.cache
    def of(name):
        found = np.stack([LEARNED[name].prepare(scan(*place)) for place in places[:3]])
        return {"bevplace++": found[:, 59:92, 59:92], "pointnetvlad": found[:, :40]}.get(name, found)

    return of


@functools.cache
def variables_of(name):
    return reference.moved(random_variables(LEARNED[name], seed=0))


@functools.cache
def network_of(name):
    return jax.jit(functools.partial(LEARNED[name].network.apply, variables_of(name), train=False))


def describe(name, inputs):
    """Return descriptors of three places, and of the first one after a change that does not matter."""
    given = inputs(name)
    return np.asarray(network_of(name)(jnp.asarray(np.concatenate([given, SAME[name](given[0])[None]]))))


@pytest.mark.parametrize("name", LEARNED)
def test_a_method_is_complete_and_has_the_published_number_of_weights(name):
    method = LEARNED[name]
    assert tuple(LEARNED) == LEARNED_NAMES and method.name == name and method.source and method.licence
    assert list(method.recipe.learning_rates) == sorted(method.recipe.learning_rates)
    shapes = jax.eval_shape(lambda: random_variables(method, seed=0))
    assert sum(leaf.size for leaf in jax.tree.leaves(shapes["params"])) == method.weights


@pytest.mark.parametrize("name", INPUTS)
def test_the_input_is_that_of_its_definition(places, wide, name):
    for points, classes in (places[0], wide):
        found = LEARNED[name].prepare(scan(points, classes))
        np.testing.assert_allclose(found, INPUTS[name](points, classes), rtol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_holes_and_the_height_of_the_sensor_do_not_change_the_input(places, name):
    points, classes = places[0]
    prepare = LEARNED[name].prepare
    expected = prepare(scan(points, classes))
    holes = np.concatenate([points, [[np.nan, 5, 0], [5, np.inf, 0]]])
    np.testing.assert_array_equal(prepare(scan(holes, [*classes, 13, 13])), expected)
    lower = scan(points - np.float32([[0, 0, 1]]), classes)
    higher = dataclasses.replace(lower, mounting=Mounting(height_m=2.73))
    assert np.mean(np.abs(prepare(higher) - expected) > 1e-3) < 0.01


@pytest.mark.parametrize("name", NAMES)
def test_a_scan_without_a_place_is_named(name):
    method = LEARNED[name]
    if method.takes == "labelled points":
        with pytest.raises(ValueError, match="scan 7: expected labels, found none"):
            method.prepare(scan(np.ones((9, 3))))
    if name != "rinet":  # scan_stream has checked it
        with pytest.raises(ValueError, match="scan 7: expected finite points"):
            method.prepare(scan(np.full((9, 3), np.nan), np.full(9, 13)))
    words = {"pointnetvlad": "scan 7: expected points within 40 m", "sgpr": "scan 7: expected clusters of 12 classes"}
    if name in words:
        with pytest.raises(ValueError, match=words[name]):
            method.prepare(scan([[5, 0, -1.7], [6, 0, -1.6]], [9, 9]))


@pytest.mark.parametrize(
    ("name", "blank"),
    [
        ("disco", scan(np.full((50, 3), 0.3))),
        ("bevplace++", Scan(image=np.zeros((151, 151), np.float32), name="scan 7")),
    ],
)
def test_a_scan_of_a_blocked_sensor_is_named(name, blank):
    with pytest.raises(ValueError, match="scan 7: expected points or pixels"):
        registry._learned_input(LEARNED[name], blank, None)


@pytest.mark.parametrize("name", NETWORKS)
def test_the_network_is_the_published_one(inputs, name):
    expected = np.stack([NETWORKS[name](variables_of(name), one) for one in inputs(name)[:2]])
    found = describe(name, inputs)[:2]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())
    assert np.abs(found - expected).max() < 0.2 * np.abs(expected[0] - expected[1]).max()


@pytest.mark.parametrize("name", NAMES)
def test_the_descriptor_is_invariant(inputs, name):
    found = describe(name, inputs)
    other, _, turned = np.linalg.norm(found[1:] - found[0], axis=1)
    assert turned < 1e-3 * np.linalg.norm(found[0]) and other > 10 * turned
    if name in ("bevplace++", "overlap-transformer", "pointnetvlad"):
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_each_input_is_rotated_by_its_own_angle(inputs, name):
    before = np.repeat(inputs(name)[:1], 4, axis=0)
    found = np.asarray(LEARNED[name].rotate_inputs(jax.random.key(1), jnp.asarray(before)))
    assert found.dtype == before.dtype and len(np.unique(found.reshape(4, -1), axis=0)) == 4
    for one in found:
        for part, expected in zip(KEPT[name](one), KEPT[name](before[0]), strict=True):
            np.testing.assert_allclose(np.sort(part, axis=0), np.sort(expected, axis=0), rtol=1e-3, atol=1e-4)


def test_rinet_loses_neighbouring_columns():
    images = jnp.asarray(np.broadcast_to(np.arange(1, 361, dtype=np.float32), (64, 12, 360)))
    found = np.asarray(LEARNED["rinet"].rotate_inputs(jax.random.key(0), images))[:, 0]
    lost = (found == 0).sum(axis=1)
    assert lost.max() <= 60 and 15 < (lost > 0).sum() < 50
    for row in found:
        left = np.roll(row, -int(np.argmin(np.where(row > 0, row, np.inf))))
        left = left[left > 0]
        assert (np.diff(left) > 0).all() and (np.diff(left) > 1).sum() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_training_reaches_every_weight_and_moves_the_statistics(inputs, name):
    method, variables = LEARNED[name], variables_of(name)
    x, kept = jnp.asarray(inputs(name)), [kind for kind in variables if kind != "params"]

    @jax.jit
    def step(params):
        def of_tuple(params):
            found, changed = method.network.apply({**variables, "params": params}, x, train=True, mutable=kept)
            apart = jnp.float32([[0, 2, 30]])
            return found, (method.loss({"params": params}, Tuples(found[None], apart, 1)), changed)

        def height(params):
            found, (loss, changed) = of_tuple(params)
            return (found * jnp.linspace(0, 1, found.shape[1])[None]).sum() + loss, changed

        return jax.grad(height, has_aux=True)(params)

    gradient, changed = step(variables["params"])
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 0, path
    before, after = (jax.tree.leaves([one[kind] for kind in kept]) for one in (variables, changed))
    assert all(np.abs(a - b).max() > 0 for a, b in zip(before, after, strict=True))


def triplet_in_loops(rows, *, reduce, squared, margin=0.5):
    def apart(a, b):
        return np.sum((a - b) ** 2) ** (1 if squared else 0.5)

    total = 0.0
    for anchor, *others in rows:
        far = max(apart(anchor, other) for other in others[:2])
        total += reduce([max(0, margin + far - apart(anchor, other)) for other in others[2:]])
    return total / len(rows)


def quadruplet_in_loops(rows, *, choose):
    total = 0.0
    for t, (anchor, *others) in enumerate(rows):
        near = choose(np.sum((anchor - other) ** 2) for other in others[:2])
        for margin, origin in ((0.5, anchor), (0.2, rows[(t + 1) % len(rows)][0])):
            total += max(0, *(margin + near - np.sum((origin - n) ** 2) for n in others[2:]))
    return total / len(rows)


def rinet_in_loops(rows, apart):
    y = np.where(apart < 3, 1, reference.sigmoid((10 - apart) / 1.5))[:, 1:]
    p = reference.sigmoid(reference.rinet_logit(variables_of("rinet"), rows[:, :1], rows[:, 1:]))
    d = np.linalg.norm(rows[:, :1] - rows[:, 1:], axis=-1)
    entropy = -y * np.log(p) - (1 - y) * np.log(1 - p)
    return np.mean(entropy) + np.mean(y * d**2 + (1 - y) * np.maximum(0.2 - d, 0) ** 2)


def sgpr_in_loops(rows):
    terms = []
    for anchor, *others in rows.astype(float):
        for i, other in enumerate(others):
            for pair in ((anchor, other), (other, anchor)):
                logit = reference.sgpr_logit(variables_of("sgpr"), *pair)
                terms.append(np.log1p(np.exp(-logit if i < 2 else logit)))
    return np.mean(terms)


LOSSES = {
    "bevplace++": lambda rows, apart: triplet_in_loops(rows, reduce=max, squared=False, margin=0.3),
    "overlap-transformer": lambda rows, apart: triplet_in_loops(rows, reduce=sum, squared=True),
    "disco": lambda rows, apart: quadruplet_in_loops(rows, choose=max),
    "pointnetvlad": lambda rows, apart: quadruplet_in_loops(rows, choose=min),
    "rinet": rinet_in_loops,
    "sgpr": lambda rows, apart: sgpr_in_loops(rows),
}


@pytest.mark.parametrize("name", NAMES)
def test_the_loss_is_that_of_the_formula(name):
    numbers = {"rinet": 288, "sgpr": 32}.get(name, 8)
    rows = 0.2 * np.random.default_rng(0).normal(size=(3, 6, numbers)).astype(np.float32)
    apart = np.float32([[0, 2, 2.9, 10, 14, 30], [0, 8, 5, 20, 13.3, np.inf], [0, 0.5, 3, 12, 14, 100]])

    def loss(rows):
        return LEARNED[name].loss(variables_of(name), Tuples(rows, jnp.asarray(apart), 2))

    assert float(loss(jnp.asarray(rows))) == pytest.approx(LOSSES[name](rows, apart), rel=1e-4)
    assert np.isfinite(jax.grad(lambda rows: loss(rows))(jnp.ones_like(rows))).all()


@pytest.mark.parametrize("name", NAMES)
def test_the_distance_is_that_of_the_formula(name):
    method, numbers = LEARNED[name], {"rinet": 288, "sgpr": 32}.get(name, 8)
    queries, database = (np.random.default_rng(n).normal(size=(n, numbers)).astype(np.float32) for n in (3, 600))
    found = learned_distance(method, variables_of(name))(queries, database)
    assert found.shape == (3, 600)
    few = database[:20].astype(float)
    if name in LOGITS:
        logits = np.array([[LOGITS[name](variables_of(name), a, b) for b in few] for a in queries.astype(float)])
        expected = 1 - reference.sigmoid(logits) if name == "rinet" else np.log1p(np.exp(-logits))
    else:
        expected = np.linalg.norm(queries[:, None] - few[None], axis=2)
    np.testing.assert_allclose(found[:, :20], expected, rtol=1e-3, atol=1e-5)


def test_inputs_of_any_number_are_described_in_batches(inputs):
    given = np.tile(inputs("rinet"), (6, 1, 1))[:17]
    found = describe_inputs(LEARNED["rinet"], variables_of("rinet"), given)
    np.testing.assert_allclose(found, network_of("rinet")(given), rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match="rinet: expected a descriptor of input 0, found values that are not finite"):
        describe_inputs(LEARNED["rinet"], variables_of("rinet"), np.full_like(given, np.nan))


def test_a_scan_and_its_ready_made_image_are_the_same_input_of_bevplace(places):
    counts = density_bev(places[0][0])
    made = grey_image(scan(places[0][0]))
    np.testing.assert_array_equal(grey_image(Scan(image=counts)), made)
    np.testing.assert_allclose(made / 25.5, counts, atol=1e-5)
    with pytest.raises(ValueError, match=r"image 3: expected a density image of 151 x 151 pixels, found \(100, 151\)"):
        grey_image(Scan(image=np.zeros((100, 151), np.float32), name="image 3"))
    with pytest.raises(ValueError, match="image 4: expected a density image"):
        grey_image(Scan(image=np.full((151, 151), 255, np.float32), name="image 4"))


def test_pointnetvlad_draws_each_voxel_above_the_ground_once(places):
    many = np.random.default_rng(0).uniform((-45, -45, -1.7), (45, 45, 20), (30000, 3)).astype(np.float32)
    found = LEARNED["pointnetvlad"].prepare(scan(many))
    assert found.shape == (4096, 3) and len(np.unique(found, axis=0)) == 4096 and np.abs(found).max() <= 1
    assert found[:, 2].min() > -1.4 / 40
    few = LEARNED["pointnetvlad"].prepare(scan(places[0][0]))
    assert few.shape == (4096, 3) and len(np.unique(few, axis=0)) < 4096


def blob(centre, n, seed):
    return np.random.default_rng(seed).uniform(-0.05, 0.05, (n, 3)) + np.asarray(centre)


def test_the_nodes_of_sgpr_are_the_centres_of_clusters_of_a_class():
    parts = [
        (blob((5, 0, 0), 120, 0), 1),
        (blob((8, 0, 0), 110, 1), 1),  # another car
        (blob((5, 0, 1), 60, 2), 16),  # a trunk at the place of the car
        (blob((9, 9, 0), 40, 3), 16),  # too few points
        (blob((1, 1, 0), 500, 4), 9),  # road has no nodes
        (blob((20, 0, 0), 50_001, 5), 13),  # too many
    ]
    points = np.concatenate([points for points, _ in parts])
    found = LEARNED["sgpr"].prepare(scan(points, np.repeat([kind for _, kind in parts], [len(p) for p, _ in parts])))
    assert found.shape == (100, 15) and found.dtype == np.float32 and not found[3:].any()
    expected = np.stack([points.mean(axis=0) for points, _ in parts[:3]])
    order = np.lexsort((found[:3, 0], -found[:3, 3]))
    np.testing.assert_allclose(found[:3][order][:, :3], expected, atol=1e-5)
    np.testing.assert_array_equal(found[:3, 3:][order], np.eye(12)[[0, 0, 8]])
    many = np.concatenate([blob((2 * i, 0, 0), 100 + i, i) for i in range(110)])
    largest = LEARNED["sgpr"].prepare(scan(many, np.full(len(many), 18)))
    np.testing.assert_allclose(np.sort(largest[:, 0]), 2.0 * np.arange(10, 110), atol=0.05)


@pytest.mark.parametrize("gap", [0.5, 2.0])
def test_clusters_link_points_within_the_gap(gap):
    points = np.random.default_rng(0).uniform(-12, 12, (200, 3)) * [1, 1, 0.1]
    linked = np.linalg.norm(points[:, None] - points[None], axis=2) <= gap
    for _ in range(8):
        linked = linked @ linked
    np.testing.assert_array_equal(linked, np.equal.outer(*[cluster_of_points(points, gap)] * 2))
