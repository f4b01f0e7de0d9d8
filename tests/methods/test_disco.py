"""DiSCO: the polar grid and the layers against numpy, the invariance to rotations, and the loss."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.recording import Record
from sglpr_jax.methods.learned.disco import DISCO, DiSCO, occupancy, prepare
from sglpr_jax.methods.learned.method import Tuples

from . import image_reference as reference


@pytest.fixture(scope="module")
def variables():
    return reference.random_statistics(jax.jit(DiSCO().init)(jax.random.key(0), jnp.zeros((1, 40, 120, 20), jnp.uint8)))


def in_loops(points):
    cells = np.zeros((40, 120, 20))
    for x, y, z in points.tolist():
        radius, degrees = math.hypot(x, y), math.degrees(math.atan2(y, x)) % 360
        layer = math.floor((z + 1.5) / 0.5)
        if 1 <= radius < 70 and 0 <= layer < 20:
            cells[int(radius / 1.75), int(degrees / 3), layer] = 1
    return cells


def test_a_cell_with_a_point_is_1(places):
    rng = np.random.default_rng(1)
    wide = np.column_stack([rng.uniform(-90, 90, (2000, 2)), rng.uniform(-4, 14, 2000)]).astype(np.float32)
    for points in (places[0][0], wide):
        np.testing.assert_array_equal(occupancy(points), in_loops(points))


def test_the_height_of_the_sensor_and_holes_do_not_change_the_input(places):
    points = places[0][0]
    expected = occupancy(points)
    holes = np.concatenate([points, np.float32([[np.nan, 5, 0], [5, np.inf, 0]])])
    np.testing.assert_array_equal(prepare(Record(points=holes)), expected)
    higher = Record(points=points - np.float32([[0, 0, 1]]), mounting=Mounting(height_m=2.73))
    assert np.mean(prepare(higher) != expected) < 1e-4
    with pytest.raises(ValueError, match="scan 5: expected finite points"):
        prepare(Record(points=np.full((9, 3), np.nan, np.float32), name="scan 5"))


def block(x, params, statistics, *, sigmoid=False):
    for i in range(2):
        layer = params[f"Convolution_{i}"]
        x = reference.conv(x, layer["kernel"], circular=True) + layer["bias"]
        x = reference.norm(x, params[f"BatchNorm_{i}"], statistics[f"BatchNorm_{i}"])
        x = 1 / (1 + np.exp(-x)) if sigmoid and i else np.maximum(x, 0)
    return x


def doubled_in_loops(x):
    """Rings between coinciding corners, sectors between neighbours on the circle."""
    _, h, w, _ = x.shape
    found = np.zeros((len(x), 2 * h, 2 * w, x.shape[3]))
    for i in range(2 * h):
        at = i * (h - 1) / (2 * h - 1)
        low = min(int(at), h - 2)
        row = x[:, low] * (low + 1 - at) + x[:, low + 1] * (at - low)
        for j in range(2 * w):
            left = math.floor((j - 0.5) / 2)
            share = (j - 0.5) / 2 - left
            found[:, i, j] = row[:, left % w] * (1 - share) + row[:, (left + 1) % w] * share
    return found


def test_the_network_is_the_published_u_net(variables):
    params, statistics = variables["params"], variables["batch_stats"]
    cells = jax.random.bernoulli(jax.random.key(0), 0.1, (1, 40, 120, 20)).astype(jnp.uint8)
    x, skipped = np.asarray(cells, np.float32), []
    for i in range(4):
        x = block(x, params[f"Block_{i}"], statistics[f"Block_{i}"])
        if i < 3:
            skipped.append(x)
            x = reference.pool(x, size=2)
    for i in range(4, 7):
        x = np.concatenate([skipped.pop(), doubled_in_loops(x)], axis=-1)
        x = block(x, params[f"Block_{i}"], statistics[f"Block_{i}"], sigmoid=i == 6)
    one = (x @ params["Dense_0"]["kernel"] + params["Dense_0"]["bias"])[0, ..., 0]
    shifted = np.fft.fftshift(np.abs(np.fft.fft2(one, norm="ortho")))
    expected = shifted[4:36, 44:76].reshape(-1)
    found = jax.jit(DiSCO().apply)(variables, cells)[0]
    np.testing.assert_allclose(found, expected, atol=1e-4 * expected.max())


def test_the_number_of_weights_is_the_published_one(variables):
    assert sum(leaf.size for leaf in jax.tree.leaves(variables["params"])) == DISCO.weights == 7_798_337


def test_rotations_by_24_degrees_do_not_change_the_descriptor(variables, places):
    """Rotations by 3 degrees change it less than another place does."""
    cells = jnp.asarray(np.stack([occupancy(points) for points, _ in places[:2]]))
    turns = [jnp.roll(cells[:1], shift, axis=2) for shift in (8, 56, 1, 4)]
    found = np.asarray(jax.jit(DiSCO().apply)(variables, jnp.concatenate([cells, *turns])))
    other, *turned_by = np.linalg.norm(found[1:] - found[0], axis=1)
    assert max(turned_by[:2]) < 1e-4 * np.linalg.norm(found[0])
    assert max(turned_by[2:]) < 0.5 * other


def test_training_moves_the_statistics_and_every_weight(variables):
    cells = jax.random.bernoulli(jax.random.key(0), 0.1, (2, 40, 120, 20)).astype(jnp.uint8).at[0].set(0)

    @jax.jit
    def step(params):
        def height(params):
            found, changed = DiSCO().apply({**variables, "params": params}, cells, train=True, mutable=["batch_stats"])
            return (found * jnp.linspace(0, 1, 1024)[None]).sum(), changed

        return jax.grad(height, has_aux=True)(params)

    gradient, changed = step(variables["params"])
    for leaf in jax.tree.leaves(gradient):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 0
    before, after = jax.tree.leaves(variables["batch_stats"]), jax.tree.leaves(changed["batch_stats"])
    assert all(np.abs(a - b).max() > 0 for a, b in zip(before, after, strict=True))


def test_each_grid_is_rotated_by_its_own_number_of_sectors():
    cells = jnp.zeros((5, 40, 120, 20), jnp.uint8).at[:, 3, 0, 2].set(1)
    found = np.asarray(DISCO.turned(jax.random.key(0), cells))
    sectors = found[:, 3, :, 2].argmax(1)
    assert found.dtype == np.uint8 and (found.sum((1, 2, 3)) == 1).all() and len(set(sectors.tolist())) == 5


def test_the_loss_is_a_lazy_quadruplet():
    descriptors = np.random.default_rng(0).normal(size=(3, 6, 4)).astype(np.float32) / 3
    total = 0.0
    for i, (anchor, *others) in enumerate(descriptors):
        square = [float(((anchor - other) ** 2).sum()) for other in others]
        far, stranger = max(square[:2]), descriptors[(i + 1) % 3, 0]
        apart = [float(((stranger - negative) ** 2).sum()) for negative in others[2:]]
        total += max(0, *(0.5 + far - d for d in square[2:])) + max(0, *(0.2 + far - d for d in apart))
    found = DISCO.loss({}, Tuples(jnp.asarray(descriptors), jnp.zeros((3, 6)), 2))
    assert found == pytest.approx(total / 3, rel=1e-5)
