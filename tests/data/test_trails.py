"""Trails of moving objects are removed from a map, and things that stay are not."""

import numpy as np
import pytest

from sglpr_jax.data.cloud_map import on_trail


def plane(x, y, step=0.1):
    """Ground at z = 0 over two ranges of coordinates."""
    x, y = np.meshgrid(np.arange(*x, step), np.arange(*y, step))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def sheet(x, z, y=0.05):
    """Vertical sheet along x, such as the side of a car or a facade."""
    x, z = np.meshgrid(np.arange(*x, 0.1), np.arange(*z, 0.1))
    return np.stack([x.ravel(), np.full(x.size, y), z.ravel()], axis=1)


STREET = plane((-5, 5), (-5, 5))


@pytest.mark.parametrize(
    ("ground", "thing", "moved"),
    [
        (STREET, sheet((-2, 2), (0.4, 1.5)), True),
        (STREET, sheet((0, 0.3), (0, 1.8)), True),  # a pedestrian
        (STREET, sheet((-2, 2), (0.4, 4.0)), False),  # a lorry or a wall
        (STREET, sheet((0, 0.3), (0, 6.0)), False),  # a trunk
        (STREET, sheet((-2, 2), (2.5, 4.0)), False),  # a crown
        (plane((-5, 5), (-5, 0)), sheet((-4, 4), (0, 2.0)), False),  # nothing was seen behind it
        (STREET[np.abs(STREET).max(axis=1) > 1], sheet((-0.9, 0.9), (0.2, 1.5)), False),  # it stayed
    ],
)
def test_low_things_on_ground_that_was_seen_are_removed(ground, thing, moved):
    points = np.concatenate([ground, thing]).astype(np.float32)
    found = on_trail(points)
    assert not found[: len(ground)].any()
    assert found[len(ground) :].mean() > 0.75 if moved else not found.any()


def test_order_does_not_matter_and_an_empty_map_has_no_trail():
    points = np.concatenate([STREET, sheet((-2, 2), (0.4, 1.5))]).astype(np.float32)
    order = np.random.default_rng(0).permutation(len(points))
    np.testing.assert_array_equal(on_trail(points[order]), on_trail(points)[order])
    assert on_trail(np.zeros((0, 3), np.float32)).shape == (0,)
