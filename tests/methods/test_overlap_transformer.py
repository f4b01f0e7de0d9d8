"""OverlapTransformer: the range image and the layers against numpy, the invariance to rotations, and the loss."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.data.recording import Record
from sglpr_jax.methods.learned.method import Tuples
from sglpr_jax.methods.learned.overlap_transformer import (
    HEIGHTS,
    OVERLAP_TRANSFORMER,
    OverlapTransformer,
    prepare,
    range_image,
)

from . import image_reference as reference


@pytest.fixture(scope="module")
def variables():
    return jax.jit(OverlapTransformer().init)(jax.random.key(0), jnp.zeros((1, 64, 900)))


def in_loops(points):
    image = np.zeros((64, 900))
    for x, y, z in points.tolist():
        distance = math.sqrt(x * x + y * y + z * z)
        row = math.floor((15 - math.degrees(math.atan2(z, math.hypot(x, y)))) / 0.625)
        column = int(math.degrees(math.atan2(y, x)) % 360 / 0.4) % 900
        if distance <= 80 and 0 <= row < 64 and not 0 < image[row, column] < distance / 80:
            image[row, column] = distance / 80
    return image


def test_a_pixel_has_its_nearest_point(places):
    rng = np.random.default_rng(1)
    wide = np.column_stack([rng.uniform(-90, 90, (3000, 2)), rng.uniform(-30, 30, 3000)]).astype(np.float32)
    for points in (places[0][0], wide):
        np.testing.assert_allclose(range_image(points), in_loops(points), rtol=1e-6)


def test_points_that_are_not_finite_are_dropped(places):
    points = places[0][0]
    holes = np.concatenate([points, np.float32([[np.nan, 5, 0], [5, np.inf, 0], [0, 0, 0]])])
    np.testing.assert_array_equal(prepare(Record(points=holes)), range_image(points))
    with pytest.raises(ValueError, match="scan 5: expected finite points"):
        prepare(Record(points=np.full((9, 3), np.nan, np.float32), name="scan 5"))


@pytest.mark.parametrize(("beams", "rows"), [((2, -24.8, 64), 43), ((15, -15, 16), 16)], ids=["HDL-64E", "VLP-16"])
def test_the_beams_of_a_sensor_are_inside(beams, rows):
    elevation = np.radians(np.linspace(*beams))
    points = 10 * np.stack([np.cos(elevation), 0 * elevation, np.sin(elevation)], axis=1).astype(np.float32)
    assert abs(np.count_nonzero(range_image(points)) - rows) <= 1


def layer_norm(x, layer):
    centred = x - x.mean(-1, keepdims=True)
    return centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-6) * layer["scale"] + layer["bias"]


def transformer(x, params):
    """Transformer layer of one sequence (n, c), with every head on its own."""
    attention = params["MultiHeadDotProductAttention_0"]
    mixed = attention["out"]["bias"].astype(np.float64)
    for head in range(4):
        query, key, value = (
            x @ attention[name]["kernel"][:, head] + attention[name]["bias"][head] for name in ("query", "key", "value")
        )
        weights = np.exp(query @ key.T / math.sqrt(query.shape[1]))
        mixed = mixed + weights / weights.sum(1, keepdims=True) @ value @ attention["out"]["kernel"][head]
    x = layer_norm(x + mixed, params["LayerNorm_0"])
    hidden = np.maximum(x @ params["Dense_0"]["kernel"] + params["Dense_0"]["bias"], 0)
    return layer_norm(x + hidden @ params["Dense_1"]["kernel"] + params["Dense_1"]["bias"], params["LayerNorm_1"])


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def test_the_network_is_its_layers_in_order(variables):
    params = jax.tree.map(np.asarray, variables["params"])
    image = np.random.default_rng(0).random((64, 900)).astype(np.float32)

    def dense(number, x):
        return x @ params[f"Dense_{number}"]["kernel"] + params[f"Dense_{number}"]["bias"]

    x = image[..., None]
    for number, (height, stride, _) in enumerate(HEIGHTS):
        rows = (len(x) - height) // stride + 1
        stack = [np.concatenate(x[i * stride : i * stride + height], axis=-1) for i in range(rows)]
        x = np.maximum(dense(number, np.stack(stack)), 0)
    x = np.maximum(dense(5, x[0]), 0)
    x = np.concatenate([x, transformer(x, params["Transformer_0"])], axis=-1)
    y = dense(6, reference.netvlad(unit(x), params["NetVLAD_0"]))
    expected = unit(y / (1 + np.exp(-dense(7, y))))
    found = jax.jit(OverlapTransformer().apply)(variables, jnp.asarray(image[None]))[0]
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_the_number_of_weights(variables):
    convolutions, inputs = 0, 1
    for height, _, features in HEIGHTS:
        convolutions, inputs = convolutions + (height * inputs + 1) * features, features
    layer = 4 * (256 * 256 + 256) + (256 * 1024 + 1024) + (1024 * 256 + 256) + 2 * 2 * 256
    netvlad = 2 * 512 * 64 + (64 * 512 + 1) * 256
    expected = convolutions + (256 + 1) * 256 + layer + netvlad + (256 + 1) * 256
    found = sum(leaf.size for leaf in jax.tree.leaves(variables["params"]))
    assert found == expected == OVERLAP_TRANSFORMER.weights == 9_484_848


def test_rotations_by_whole_columns_do_not_change_the_descriptor(variables, places):
    images = jnp.asarray(np.stack([range_image(points) for points, _ in places[:2]]))
    turns = [jnp.roll(images[:1], shift, axis=2) for shift in (1, 17, 450)]
    found = np.asarray(jax.jit(OverlapTransformer().apply)(variables, jnp.concatenate([images, *turns])))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-5)
    other, *turned_by = np.linalg.norm(found[1:] - found[0], axis=1)
    assert max(turned_by) < 1e-4 and other > 100 * max(turned_by)


def test_training_reaches_every_weight(variables):
    images = jax.random.uniform(jax.random.key(0), (4, 64, 900)).at[0].set(0)

    @jax.jit
    def gradient(params):
        def tuples_loss(params):
            found = OverlapTransformer().apply({"params": params}, images, train=True)
            return OVERLAP_TRANSFORMER.loss({}, Tuples(found.reshape(1, 4, -1), jnp.zeros((1, 4)), 1))

        return jax.grad(tuples_loss)(params)

    for leaf in jax.tree.leaves(gradient(variables["params"])):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 0


def test_each_image_is_rotated_by_its_own_number_of_columns():
    images = jnp.zeros((5, 64, 900)).at[:, 3, 0].set(1)
    found = np.asarray(OVERLAP_TRANSFORMER.turned(jax.random.key(0), images))
    assert (found.sum((1, 2)) == 1).all() and len(set(found[:, 3].argmax(1).tolist())) == 5


def test_the_loss_sums_over_the_negatives():
    descriptors = np.random.default_rng(0).normal(size=(2, 6, 4)).astype(np.float32) / 3
    total = 0.0
    for anchor, *others in descriptors:
        square = [float(((anchor - other) ** 2).sum()) for other in others]
        total += sum(max(0, 0.5 + max(square[:3]) - d) for d in square[3:])
    found = OVERLAP_TRANSFORMER.loss({}, Tuples(jnp.asarray(descriptors), jnp.zeros((2, 6)), 3))
    assert found == pytest.approx(total / 2, rel=1e-5)
