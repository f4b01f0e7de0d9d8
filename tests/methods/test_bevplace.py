"""BEVPlace++: the encoder and the rotations against numpy, the invariance, the input and the loss."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.bev import rotate_image
from sglpr_jax.data.density_image import density_bev
from sglpr_jax.data.recording import Record
from sglpr_jax.methods.learned.bevplace import (
    BEVPLACE,
    REIN,
    RESNET34_NETVLAD,
    Encoder,
    eight_turns,
    grey_image,
    resampled,
    resampled_maps,
    resized,
    turned,
    turned_back,
    turned_taps,
)
from sglpr_jax.methods.learned.method import Tuples

from . import image_reference as reference


def images(n, size, seed=0):
    rng = np.random.default_rng(seed)
    grey = np.where(rng.random((n, size, size)) < 0.3, rng.integers(0, 256, (n, size, size)), 0)
    return jnp.asarray(grey, jnp.uint8)


@pytest.fixture(scope="module")
def variables():
    """Variables of both networks, because the rotations have no weights."""
    start = jax.jit(REIN(1).init)(jax.random.key(0), images(1, 33))
    return reference.random_statistics(start)


def cubic(t):
    t = abs(t)
    if t <= 1:
        return 1.25 * t**3 - 2.25 * t**2 + 1
    return -0.75 * t**3 + 3.75 * t**2 - 6 * t + 3 if t < 2 else 0.0


def sample(image, row, column):
    """The bicubic value at a point, with zeros outside."""
    total = 0.0
    for i in range(math.floor(row) - 1, math.floor(row) + 3):
        for j in range(math.floor(column) - 1, math.floor(column) + 3):
            if 0 <= i < image.shape[0] and 0 <= j < image.shape[1]:
                total += cubic(row - i) * cubic(column - j) * image[i, j]
    return total


@pytest.mark.parametrize("degrees", [45, -45, 20])
def test_a_rotation_is_bicubic(degrees):
    image = jax.random.normal(jax.random.key(0), (9, 9))
    angle, expected = math.radians(degrees), np.zeros((9, 9))
    for i in range(9):
        for j in range(9):
            x, y = j - 4, 4 - i
            from_x, from_y = (
                x * math.cos(angle) + y * math.sin(angle),
                y * math.cos(angle) - x * math.sin(angle),
            )
            expected[i, j] = sample(image, 4 - from_y, 4 + from_x)
    taps = turned_taps(9, degrees)
    np.testing.assert_allclose(resampled(image[None], taps)[0], expected, atol=1e-5)
    maps = jnp.stack([image, 2 * image], axis=-1)
    np.testing.assert_allclose(resampled_maps(maps[None], taps)[0, ..., 1], 2 * expected, atol=1e-5)


def test_a_rotation_has_the_direction_of_rotate_image():
    down, right = np.mgrid[:33, :33] - 16
    smooth = jnp.asarray(np.exp(-((down - 5) ** 2 + (right + 3) ** 2) / 20), jnp.float32)[None]
    for degrees in (45, 90, 120):
        expected = rotate_image(smooth, jnp.float32([math.radians(degrees)]))
        np.testing.assert_allclose(resampled(smooth, turned_taps(33, degrees)), expected, atol=0.04)


def test_resizing_is_bicubic_between_coinciding_corners():
    maps = jax.random.normal(jax.random.key(0), (1, 5, 5, 2))
    found = np.asarray(resized(maps, 9))
    for i in range(9):
        for j in range(9):
            assert found[0, i, j, 1] == pytest.approx(sample(np.asarray(maps[0, ..., 1]), i / 2, j / 2), abs=1e-5)


def test_eight_rotations_and_back():
    x = jax.random.normal(jax.random.key(0), (2, 17, 17))
    turns = np.asarray(eight_turns(x)).reshape(8, 2, 17, 17)
    for k, degrees in enumerate((0, 90, 180, 270, 45, 135, 225, 315)):
        np.testing.assert_allclose(turns[k], resampled(x, turned_taps(17, degrees)), atol=1e-4)
    down, right = np.mgrid[:17, :17] - 8
    smooth = jnp.asarray(np.exp(-((down - 2) ** 2 + (right + 1) ** 2) / 12), jnp.float32)[None]
    back = turned_back(eight_turns(smooth)[..., None])[..., 0]
    np.testing.assert_allclose(back, np.broadcast_to(smooth, back.shape), atol=0.04)


def block(x, name, number, variables, stride=1):
    layers, statistics = variables["params"][name], variables["batch_stats"][name]
    y = reference.conv(x, layers["Convolution_0"]["kernel"], stride=stride)
    y = np.maximum(reference.norm(y, layers["BatchNorm_0"], statistics["BatchNorm_0"]), 0)
    y = reference.conv(y, layers["Convolution_1"]["kernel"])
    y = reference.norm(y, layers["BatchNorm_1"], statistics["BatchNorm_1"])
    if stride > 1:
        x = reference.conv(x, layers["Convolution_2"]["kernel"], stride=stride)
        x = reference.norm(x, layers["BatchNorm_2"], statistics["BatchNorm_2"])
    return np.maximum(x + y, 0)


def test_the_encoder_is_resnet_34_of_three_equal_colours(variables):
    own = {kind: variables[kind]["Encoder_0"] for kind in ("params", "batch_stats")}
    grey = jax.random.uniform(jax.random.key(0), (2, 25, 25))
    x = reference.conv(np.repeat(grey[..., None], 3, -1), own["params"]["kernel"], stride=2)
    x = np.maximum(reference.norm(x, own["params"]["BatchNorm_0"], own["batch_stats"]["BatchNorm_0"]), 0)
    x = reference.pool(x, size=3, border=1)
    for number in range(7):
        x = block(x, f"Block_{number}", number, own, stride=2 if number == 3 else 1)
    found = jax.jit(lambda v, x: Encoder().apply(v, x, train=False))(own, grey)
    assert found.shape == (2, 4, 4, 128)
    np.testing.assert_allclose(found, x, atol=1e-4 * np.abs(x).max())


@pytest.mark.parametrize("method", [BEVPLACE, RESNET34_NETVLAD], ids=lambda method: method.name)
def test_the_number_of_weights_is_the_published_one(method):
    shapes = jax.eval_shape(method.network.init, jax.random.key(0), images(1, 151))
    assert sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(shapes["params"])) == method.weights == 1_364_288


@pytest.mark.parametrize("size", [33, 39], ids=["8 m + 1", "with a border"])
def test_quarter_turns_do_not_change_the_descriptor(variables, size):
    x = images(1, size)
    describe = jax.jit(lambda x: REIN(8).apply(variables, x))
    found = describe(jnp.concatenate([x, *(jnp.rot90(x, k, (1, 2)) for k in (1, 2, 3)), images(1, size, seed=1)]))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-5)
    apart = np.linalg.norm(found - found[:1], axis=1)
    assert apart[1:4].max() < 1e-5 and apart[4] > 1e-3


def test_training_moves_the_statistics_and_every_weight(variables):
    x = images(4, 33)

    @jax.jit
    def step(params):
        def tuples_loss(params):
            found, changed = REIN(8).apply({**variables, "params": params}, x, train=True, mutable=["batch_stats"])
            return BEVPLACE.loss({}, Tuples(found.reshape(1, 4, -1), jnp.zeros((1, 4)), 1)), changed

        return jax.value_and_grad(tuples_loss, has_aux=True)(params)

    (value, changed), gradient = step(variables["params"])
    assert value > 0
    for leaf in jax.tree.leaves(gradient):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 0
    before, after = jax.tree.leaves(variables["batch_stats"]), jax.tree.leaves(changed["batch_stats"])
    assert all(np.abs(a - b).max() > 0 for a, b in zip(before, after, strict=True))


def test_an_even_image_is_an_error(variables):
    with pytest.raises(ValueError, match="odd number of rows, found 32"):
        REIN(1).apply(variables, images(1, 32))


def test_a_scan_and_its_ready_made_image_are_the_same_input(places):
    points = places[0][0]
    made = grey_image(Record(points=points, name="a scan"))
    counts = density_bev(points)
    assert made.dtype == np.uint8 and made.shape == (151, 151) and made.max() == 255
    np.testing.assert_array_equal(grey_image(Record(image=counts)), made)
    np.testing.assert_allclose(made / 25.5, counts, atol=1e-5)


def test_other_images_and_scans_are_errors():
    with pytest.raises(ValueError, match=r"image 3: expected a density image of 151 x 151 pixels, found \(100, 151\)"):
        grey_image(Record(image=np.zeros((100, 151), np.float32), name="image 3"))
    with pytest.raises(ValueError, match="image 4: expected a density image"):
        grey_image(Record(image=np.full((151, 151), 255, np.float32), name="image 4"))
    with pytest.raises(ValueError, match="scan 5: expected finite points"):
        grey_image(Record(points=np.full((9, 3), np.nan, np.float32), name="scan 5"))


def test_each_image_is_rotated_by_its_own_angle():
    x = jnp.repeat(images(1, 33), 3, axis=0)
    found = np.asarray(turned(jax.random.key(1), x))
    assert found.dtype == np.uint8 and len(np.unique(found.reshape(3, -1), axis=0)) == 3
    angles = jax.random.uniform(jax.random.key(1), (3,), maxval=2 * np.pi)
    expected = rotate_image(x.astype(jnp.float32), angles)
    np.testing.assert_allclose(found, expected, atol=0.51)


def test_the_loss_is_that_of_the_hardest_negative():
    descriptors = np.random.default_rng(0).normal(size=(3, 6, 4)).astype(np.float32) / 2
    total = 0.0
    for anchor, positive, *negatives in descriptors:
        near = np.linalg.norm(anchor - positive)
        total += max(max(0.3 + near - np.linalg.norm(anchor - other), 0) for other in negatives)
    found = BEVPLACE.loss({}, Tuples(jnp.asarray(descriptors), jnp.zeros((3, 6)), 1))
    assert found == pytest.approx(total / 3, rel=1e-5)
