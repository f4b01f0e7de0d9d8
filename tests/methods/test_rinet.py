"""RINet: its input, its invariance, its number of weights, its loss and its distance."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.data.recording import Record
from sglpr_jax.methods.learned.describe import learned_distance
from sglpr_jax.methods.learned.method import Tuples
from sglpr_jax.methods.learned.rinet import CLASSES, RINET, loss, prepare, ring_image, same_place, strongest_phase
from sglpr_jax.methods.learned.rinet import turned as turned_inputs
from sglpr_jax.methods.learned.weights_file import random_variables, weight_count


@pytest.fixture(scope="module")
def variables():
    """Random weights, with biases and statistics that are not trivial."""
    rng = np.random.default_rng(0)
    fresh = random_variables(RINET, seed=0)
    return jax.tree.map(lambda leaf: leaf + rng.uniform(0, 0.1, leaf.shape).astype(np.float32), fresh)


@pytest.fixture(scope="module")
def describe(variables):
    return jax.jit(functools.partial(RINET.network.apply, variables, train=False))


def a_scan(rng, n=4000):
    """Points in the middle of degrees, with classes."""
    degree, reach = rng.integers(-180, 180, n), rng.uniform(2, 60, n)
    angle = np.radians(degree + rng.uniform(0.3, 0.7, n))
    points = np.stack([reach * np.cos(angle), reach * np.sin(angle), rng.uniform(-2, 2, n)], axis=1)
    return points.astype(np.float32), rng.integers(0, 20, n).astype(np.int32)


def sparse_images(rng, n):
    """Ring images as scans give them: three quarters of the cells are empty."""
    return (rng.uniform(0, 1, (n, 12, 360)) * (rng.random((n, 12, 360)) < 0.25)).astype(np.float32)


def by_the_letter(points, classes):
    image = np.zeros((12, 360))
    for (x, y, _), label in zip(points.astype(float), classes, strict=True):
        reach = np.hypot(x, y)
        if label in CLASSES and reach <= 50:
            cell = CLASSES.index(label), int(np.floor((np.arctan2(y, x) + np.pi) * 180 / np.pi))
            choose = max if label == 9 else min
            image[cell] = choose(image[cell], reach) if image[cell] else reach
    return image / 50


def test_the_number_of_weights():
    assert weight_count(random_variables(RINET, seed=0)) == RINET.weights == 98_765


def test_the_input_holds_the_nearest_point_and_the_farthest_of_the_road():
    points, classes = a_scan(np.random.default_rng(1))
    np.testing.assert_allclose(ring_image(points, classes), by_the_letter(points, classes), rtol=1e-6)


def test_points_that_are_not_finite_or_have_other_classes_are_ignored():
    points = np.array([[3, 0.1, 0], [np.nan, 1, 0], [np.inf, 1, 0], [60, 1, 0], [4, 1, 0]], np.float32)
    image = ring_image(points, np.array([13, 13, 13, 13, 5], np.int32))
    assert np.count_nonzero(image) == 1 and image[5, 181] == pytest.approx(np.hypot(3, 0.1) / 50)


def test_a_scan_without_labels_is_an_error_that_names_it():
    with pytest.raises(ValueError, match="scan 7 of sequence x: expected labels, found none"):
        prepare(Record(points=np.ones((3, 3), np.float32), name="scan 7 of sequence x"))


def test_rolled_inputs_have_the_same_descriptor(describe):
    image = sparse_images(np.random.default_rng(2), 1)[0]
    rolled = np.stack([np.roll(image, degrees, axis=1) for degrees in (0, 1, 2, 3, 7, 90, 181, 359)])
    descriptors = np.asarray(describe(jnp.asarray(rolled)))
    assert descriptors.shape == (8, 288)
    np.testing.assert_allclose(descriptors[1:], np.broadcast_to(descriptors[0], (7, 288)), rtol=1e-5, atol=1e-6)
    other = np.asarray(describe(jnp.asarray(sparse_images(np.random.default_rng(3), 8))))
    assert np.abs(other - descriptors).max() > 1e-3


@pytest.mark.parametrize("degrees", [1, 45, 180, 301])
def test_scans_rotated_by_whole_degrees_have_rolled_inputs(degrees):
    points, classes = a_scan(np.random.default_rng(4))
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    moved = points @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]], np.float32)
    inputs = ring_image(moved, classes)
    np.testing.assert_allclose(inputs, np.roll(ring_image(points, classes), degrees, axis=1), atol=1e-5)


def test_the_strongest_phase_is_kept():
    x = np.random.default_rng(5).normal(size=(4, 12, 3)).astype(np.float32)
    kept = np.asarray(strongest_phase(jnp.asarray(x), 3))
    for image, found in zip(x, kept, strict=True):
        phases = [image[start::3] for start in range(3)]
        np.testing.assert_array_equal(found, max(phases, key=lambda phase: np.abs(phase).sum()))


def test_turning_keeps_the_columns_but_for_a_gap():
    images = jnp.asarray(np.broadcast_to(np.arange(1, 361, dtype=np.float32), (64, 12, 360)))
    found = np.asarray(turned_inputs(jax.random.key(0), images))
    lost = (found[:, 0] == 0).sum(axis=1)
    assert lost.max() <= 60 and 15 < (lost > 0).sum() < 50
    assert len({int(np.argmax(row)) for row in found[:, 0]}) > 32
    for row in found[:, 0]:
        start = int(np.argmin(np.where(row > 0, row, np.inf)))
        before = np.roll(row, -start)
        left = before[before > 0]
        assert (np.diff(left) > 0).all() and (np.diff(left) > 1).sum() <= 1


def test_the_label_is_soft():
    apart = np.array([0, 2.9, 3.0, 10, 13.3, 40, np.inf])
    expected = 1 - 1 / (1 + np.exp((10 - apart) / 1.5))
    np.testing.assert_allclose(same_place(jnp.asarray(apart)), np.where(apart < 3, 1, expected), atol=1e-6)


def score_by_the_letter(variables, difference):
    weights = variables["params"]["score"]
    hidden = difference @ np.asarray(weights["Dense_0"]["kernel"]) + np.asarray(weights["Dense_0"]["bias"])
    hidden = np.where(hidden > 0, hidden, 0.1 * hidden)
    return (hidden @ np.asarray(weights["Dense_1"]["kernel"]) + np.asarray(weights["Dense_1"]["bias"]))[..., 0]


def test_the_loss_is_that_of_the_formula(variables):
    rng = np.random.default_rng(6)
    descriptors = rng.normal(size=(5, 3, 288)).astype(np.float32) * 0.01
    apart = np.array([[0, 2, 30], [0, 8, 20], [0, 12, 14], [0, 0.5, np.inf], [0, 5, 100]], np.float32)
    logits = score_by_the_letter(variables, np.abs(descriptors[:, :1] - descriptors[:, 1:]))
    y = np.where(apart < 3, 1, 1 - 1 / (1 + np.exp((10 - apart) / 1.5)))[:, 1:]
    p = 1 / (1 + np.exp(-logits))
    d = np.linalg.norm(descriptors[:, :1] - descriptors[:, 1:], axis=-1)
    expected = np.mean(-y * np.log(p) - (1 - y) * np.log(1 - p)) + np.mean(
        y * d**2 + (1 - y) * np.maximum(0.2 - d, 0) ** 2
    )
    found = loss(variables, Tuples(jnp.asarray(descriptors), jnp.asarray(apart), 1))
    assert float(found) == pytest.approx(expected, rel=1e-5)


def test_the_gradient_at_equal_descriptors_is_finite(variables):
    tuples = Tuples(jnp.ones((2, 3, 288)), jnp.asarray([[0.0, 0, jnp.inf]] * 2), 1)
    gradient = jax.grad(lambda descriptors: loss(variables, tuples._replace(descriptors=descriptors)))
    assert np.isfinite(np.asarray(gradient(tuples.descriptors))).all()


def test_the_distance_is_one_minus_the_score(variables):
    rng = np.random.default_rng(7)
    queries, database = (rng.normal(size=(n, 288)).astype(np.float32) for n in (3, 700))
    found = learned_distance(RINET, variables)(queries, database)
    logits = score_by_the_letter(variables, np.abs(queries[:, None] - database[None]))
    np.testing.assert_allclose(found, 1 - 1 / (1 + np.exp(-logits)), atol=1e-5)
