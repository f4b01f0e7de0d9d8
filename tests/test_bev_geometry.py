"""Images and points rotated, cut and put on even cells, against numpy."""

import hypothesis
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.bev import centre_crop, even_cells, rasterize, rotate_image, rotate_labels, rotate_points, uncropped
from sglpr_jax.grid import Grid

angles = st.floats(-10, 10, width=32)


@hypothesis.settings(deadline=None, max_examples=25)
@hypothesis.given(hnp.arrays(np.float32, (2, 5, 3), elements=st.floats(-100, 100, width=32)), st.tuples(angles, angles))
def test_points_turn_as_numpy_turns_them(points, turns):
    turns = np.float32(turns)
    found = rotate_points(points, turns)
    cos, sin = np.cos(turns.astype(np.float64)), np.sin(turns.astype(np.float64))
    for b in range(2):
        world_from_lidar = np.array([[cos[b], -sin[b], 0], [sin[b], cos[b], 0], [0, 0, 1]])
        np.testing.assert_allclose(found[b], points[b] @ world_from_lidar.T, atol=1e-4)
    np.testing.assert_array_equal(found[..., 2], points[..., 2])
    np.testing.assert_allclose(jax.vmap(rotate_points)(points, turns), found, atol=1e-5)


def test_a_quarter_turn_takes_forward_to_left():
    turned = rotate_points(np.float32([[1, 0, 5]]), np.float32(np.pi / 2))
    np.testing.assert_allclose(turned, [[0, 1, 5]], atol=1e-6)


@pytest.mark.parametrize("size", [8, 9])
@pytest.mark.parametrize("quarters", [0, 1, 2, 3, -1])
def test_quarter_turns_of_images_move_whole_cells(size, quarters):
    image = np.random.default_rng(0).uniform(0, 10, (size, size)).astype(np.float32)
    turned = rotate_image(image, np.float32(quarters * np.pi / 2))
    np.testing.assert_allclose(turned, np.rot90(image, quarters), atol=2e-4)


def test_half_a_turn_of_an_oblong_image():
    image = np.random.default_rng(0).uniform(0, 10, (6, 9)).astype(np.float32)
    np.testing.assert_allclose(rotate_image(image, np.float32(np.pi)), image[::-1, ::-1], atol=2e-4)


def test_beyond_the_border_is_zero():
    turned = np.asarray(rotate_image(np.ones((9, 9), np.float32), np.float32(np.pi / 4)))
    assert turned[4, 4] == pytest.approx(1.0)
    assert turned[0, 0] == turned[0, 8] == turned[8, 0] == turned[8, 8] == 0.0


def bump(centre, size, resolution_m):
    """A smooth image in eq. 1's orientation: a Gaussian hill of 2 m at `centre` = (x, y)."""
    steps = (np.arange(size) - (size - 1) / 2) * resolution_m
    x, y = np.meshgrid(steps, -steps)
    return np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * 2.0**2)).astype(np.float32)


@hypothesis.settings(deadline=None, max_examples=25)
@hypothesis.given(angles, st.floats(-6, 6), st.floats(-6, 6))
def test_images_turn_as_their_points_do(angle, x, y):
    turned_centre = np.asarray(rotate_points(np.float32([[x, y, 0]]), np.float32(angle)))[0]
    found = rotate_image(bump((x, y), 64, 0.4), np.float32(angle))
    np.testing.assert_allclose(found, bump(turned_centre, 64, 0.4), atol=0.01)


def test_turned_points_and_turned_images_rasterise_alike():
    """On a dense cloud, where a cell's count is smooth, turning before and after eq. 1 is the same up to noise."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal([4, 1, 0], 2, (100_000, 3)), rng.normal([-3, -4, 0], 2, (100_000, 3))])
    points, angle, grid = points.astype(np.float32), np.float32(0.7), Grid(0.5, 64, 64)
    before = np.asarray(rasterize(rotate_points(points, angle), grid=grid))
    after = np.asarray(rotate_image(rasterize(points, grid=grid).astype(jnp.float32), angle))
    assert np.corrcoef(before.ravel(), after.ravel())[0, 1] > 0.995
    assert np.corrcoef(before.ravel(), np.rot90(after).ravel())[0, 1] < 0.7


def test_image_batches_vmap_and_jit_agree():
    rng = np.random.default_rng(0)
    images = rng.uniform(0, 10, (2, 3, 7, 8)).astype(np.float32)
    turns = rng.uniform(-3, 3, (2, 3)).astype(np.float32)
    batched = rotate_image(images, turns)
    one_by_one = np.stack([rotate_image(images[b], turns[b]) for b in np.ndindex(2, 3)]).reshape(images.shape)
    np.testing.assert_allclose(batched, one_by_one, atol=1e-4)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.vmap(rotate_image)))(images, turns), one_by_one, atol=1e-4)


def test_the_wide_middle_of_an_odd_image_becomes_two_cells_of_half_the_count():
    rng = np.random.default_rng(0)
    points = rng.uniform(-2.0, 2.0, (500, 2))
    wide, edges = np.trunc(points / 0.5).astype(int) + 3, np.arange(-2.0, 2.1, 0.5)
    image = np.zeros((2, 7, 7), np.float32)
    np.add.at(image, (0, 6 - wide[:, 1], wide[:, 0]), 1.0)  # as density images count: truncated, row against y
    found = np.asarray(even_cells(jnp.asarray(image)))
    assert found.shape == (2, 8, 8) and not found[1].any()
    counts = np.histogram2d(-points[:, 1], points[:, 0], [edges, edges])[0]  # the cells of eq. 1
    outer = [0, 1, 2, 5, 6, 7]
    np.testing.assert_array_equal(found[0][np.ix_(outer, outer)], counts[np.ix_(outer, outer)])
    np.testing.assert_array_equal(found[0, 3:5].sum(0)[outer], counts[3:5].sum(0)[outer])
    np.testing.assert_array_equal(found[0, 3], found[0, 4])
    assert found[0].sum() == 500
    np.testing.assert_array_equal(even_cells(jnp.asarray(found)), found)
    np.testing.assert_allclose(jax.jit(jax.vmap(even_cells))(jnp.asarray(image)), found)


def nearest_labels(labels, angle):
    """Each cell's label in a turned map by float64, and which cells lie too near to a cell's edge to tell."""
    height, width = labels.shape
    down, right = np.mgrid[:height, :width] - np.array([height - 1, width - 1])[:, None, None] / 2
    cos, sin = np.cos(float(angle)), np.sin(float(angle))
    source = np.stack([cos * down + sin * right + (height - 1) / 2, cos * right - sin * down + (width - 1) / 2])
    v, u = np.floor(source + 0.5).astype(int)
    inside = (v >= 0) & (v < height) & (u >= 0) & (u < width)
    found = np.where(inside, labels[v.clip(0, height - 1), u.clip(0, width - 1)], 0)
    return found, (np.abs(source % 1 - 0.5) < 1e-3).any(0)


@hypothesis.settings(deadline=None, max_examples=25)
@hypothesis.given(hnp.arrays(np.int32, (2, 7, 10), elements=st.integers(0, 34)), st.tuples(angles, angles))
def test_labels_turn_to_the_nearest_cell(labels, turns):
    turns = np.float32(turns)
    found = np.asarray(rotate_labels(labels, turns))
    assert found.dtype == np.int32
    np.testing.assert_array_equal(jax.jit(jax.vmap(rotate_labels))(labels, turns), found)
    for b in range(2):
        expected, at_an_edge = nearest_labels(labels[b], turns[b])
        np.testing.assert_array_equal(np.where(at_an_edge, expected, found[b]), expected)


@pytest.mark.parametrize("size", [8, 9])
def test_labels_make_quarter_turns_as_images_do(size):
    labels = np.random.default_rng(0).integers(0, 20, (size, size)).astype(np.int32)
    for quarters in range(-1, 4):
        turned = rotate_labels(labels, np.float32(quarters * np.pi / 2))
        np.testing.assert_array_equal(turned, np.rot90(labels, quarters))


@hypothesis.settings(deadline=None, max_examples=25)
@hypothesis.given(hnp.arrays(np.int32, (9, 12), elements=st.sampled_from([0, 0, 0, 7])), angles)
def test_no_label_is_turned_onto_an_empty_cell(labels, angle):
    image = rotate_image((labels > 0).astype(np.float32), np.float32(angle))
    assert (np.asarray(image)[np.asarray(rotate_labels(labels, np.float32(angle))) > 0] > 0).all()


@pytest.mark.parametrize("shape, kept", [((4, 6), 16), ((5, 6), 12), ((5, 9), 9)])
def test_what_was_cropped_lies_where_it_was(shape, kept):
    labels = np.random.default_rng(0).integers(1, 20, shape).astype(np.int32)
    crop = np.array(centre_crop(even_cells(jnp.asarray(labels)), height=4, width=4))
    whole = uncropped(crop, shape=shape)
    assert whole.shape == shape and (whole > 0).sum() == kept
    np.testing.assert_array_equal(whole, np.where(whole > 0, labels, 0))
    crop[1], crop[2] = 0, 7
    assert (uncropped(crop, shape=shape)[shape[0] // 2] == 7).sum() == (shape[1] % 2 == 0) + 3


def test_the_labels_of_a_wide_cell_are_those_of_both_halves():
    labels = np.arange(15, dtype=np.int32).reshape(3, 5)
    found = even_cells(jnp.asarray(labels))
    np.testing.assert_array_equal(found, labels[[0, 1, 1, 2]][:, [0, 1, 2, 2, 3, 4]])


def test_the_centre_is_cropped():
    image = jnp.arange(2.0 * 5 * 7).reshape(2, 5, 7)
    np.testing.assert_array_equal(centre_crop(image, height=3, width=3), image[:, 1:4, 2:5])
    np.testing.assert_array_equal(centre_crop(image, height=4, width=7), image[:, :4, :])
    with pytest.raises(ValueError, match="6 x 3"):
        centre_crop(image, height=6, width=3)
