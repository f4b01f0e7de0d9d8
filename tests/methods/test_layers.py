"""Layers of the learned methods: NetVLAD and its clusters at the start, the encoder and its rotations."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from sglpr_jax.bev import rotate_image
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.learned.bevplace import (
    REIN,
    Encoder,
    eight_rotations,
    resample_maps,
    resize_maps,
    rotate_maps_back,
    rotation_taps,
)
from sglpr_jax.methods.learned.layers import FEATURES, LOCAL, NetVLAD, fit_clusters
from sglpr_jax.methods.learned.trained import random_variables
from sglpr_jax.models.layers import l2_normalize

from . import learned_reference as reference

DIRECTIONS = l2_normalize(2 + jax.random.normal(jax.random.key(0), (8, 16)))


class Points(nn.Module):
    """Local features near 8 directions, which differ little and are chosen by the input, and 8 clusters."""

    @nn.compact
    def __call__(self, inputs, *, train):
        local = l2_normalize(DIRECTIONS[inputs] + 0.01 * jnp.cos(jnp.arange(16.0)[None, None] * inputs[..., None]))
        self.sow(LOCAL, FEATURES, local)
        return NetVLAD(8)(local)


def test_clusters_start_at_those_of_the_features():
    inputs = np.random.default_rng(0).integers(0, 8, (20, 30))
    before = {"params": Points().init(jax.random.key(0), inputs[:1], train=False)["params"]}
    after = fit_clusters(Points(), before, inputs)
    layer = after["params"]["NetVLAD_0"]
    nearest = np.linalg.norm(DIRECTIONS[:, None] - layer["centres"][None], axis=-1)
    assert nearest.min(1).max() < 0.1 and sorted(nearest.argmin(1)) == list(range(8))
    found, local = Points().apply(after, inputs, train=False, mutable=[LOCAL])
    logits = np.sort(local[LOCAL][FEATURES][0] @ layer["assignment"], axis=-1)
    assert np.mean(logits[..., -1] - logits[..., -2]) == pytest.approx(np.log(100), rel=0.05)
    apart = [
        np.linalg.norm(x[:, None] - x[None], axis=-1).mean()
        for x in (found, Points().apply(before, inputs, train=False))
    ]
    assert apart[0] > 1.5 * apart[1]


def test_the_encoder_is_resnet_34():
    variables = reference.moved(random_variables(LEARNED["resnet34-netvlad"], seed=0))
    grey = jax.random.uniform(jax.random.key(0), (2, 25, 25))
    expected = reference.encoder(variables, grey)
    own = {kind: variables[kind]["Encoder_0"] for kind in ("params", "batch_stats")}
    found = jax.jit(lambda v, x: Encoder().apply(v, x, train=False))(own, grey)
    assert found.shape == (2, 4, 4, 128)
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
    with pytest.raises(ValueError, match="odd number of rows, found 32"):
        REIN(1).apply(variables, jnp.zeros((1, 32, 32), jnp.uint8))


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


@pytest.mark.parametrize("degrees", [-45, 20])
def test_a_rotation_and_a_new_size_are_bicubic(degrees):
    image = jax.random.normal(jax.random.key(0), (9, 9))
    grey = np.asarray(image)
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turned, larger = np.zeros((9, 9)), np.zeros((17, 17))
    for i, j in np.ndindex(9, 9):
        x, y = j - 4, 4 - i
        turned[i, j] = sample(grey, 4 - (y * cos - x * sin), 4 + (x * cos + y * sin))
    for i, j in np.ndindex(17, 17):
        larger[i, j] = sample(grey, i / 2, j / 2)
    taps = rotation_taps(9, degrees)
    maps = jnp.stack([image, 2 * image], axis=-1)[None]
    np.testing.assert_allclose(resample_maps(maps, taps)[0, ..., 1], 2 * turned, atol=1e-5)
    np.testing.assert_allclose(resize_maps(maps, 17)[0, ..., 1], 2 * larger, atol=1e-5)


def test_eight_rotations_and_back():
    down, right = np.mgrid[:33, :33] - 16
    smooth = jnp.asarray(np.exp(-((down - 5) ** 2 + (right + 3) ** 2) / 20), jnp.float32)[None]
    turns = np.asarray(eight_rotations(smooth))
    for turn, degrees in zip(turns, (0, 90, 180, 270, 45, 135, 225, 315), strict=True):
        expected = rotate_image(smooth, jnp.float32([math.radians(degrees)]))[0]
        np.testing.assert_allclose(turn, expected, atol=0.04)
    back = rotate_maps_back(jnp.asarray(turns)[..., None])[..., 0]
    np.testing.assert_allclose(back, np.broadcast_to(smooth, back.shape), atol=0.04)
