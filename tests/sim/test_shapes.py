"""Which shapes are there at a time, and the intervals of rays inside unit solids."""

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from surfaces import NOTHING, shapes

from sglpr_jax.sim.shapes import SOLIDS, Vectors, at_time

LEVELS = (
    lambda p: np.abs(p).max(-1),
    lambda p: np.maximum(np.hypot(p[..., 0], p[..., 1]), np.abs(p[..., 2])),
    lambda p: np.linalg.norm(p, axis=-1),
)
"""Below 1 inside the unit cube, cylinder and ball."""


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0, 1, 2]))
def test_rays_are_inside_their_interval_and_outside_elsewhere(seed, kind):
    rng = np.random.default_rng(seed)
    origin, direction = rng.uniform(-2, 2, (200, 3)).astype(np.float32), rng.normal(size=(200, 3)).astype(np.float32)
    enter, leave = jax.jit(SOLIDS[kind])(Vectors(*origin.T), Vectors(*direction.T))
    enter, leave = np.asarray(enter, np.float64), np.asarray(leave, np.float64)
    hit = enter < leave - 1e-2

    def level(t: np.ndarray) -> np.ndarray:
        return LEVELS[kind](origin + t[:, None] * direction)

    assert 10 < hit.sum() < 190
    assert np.all(level((enter + leave) / 2)[hit] < 1)
    np.testing.assert_allclose(level(enter)[hit], 1, atol=1e-3)
    np.testing.assert_allclose(level(leave)[hit], 1, atol=1e-3)
    steps = np.linspace(-20, 20, 400)
    missed = enter > leave
    assert np.all(np.stack([level(np.full(200, t)) for t in steps])[:, missed] > 1)


def test_shapes_are_where_and_while_they_are_present():
    car = shapes((0, 0, 1, 2, 1, 1, 0, 252), velocity=(10.0, -5.0), since=0.0, until=3.0)
    np.testing.assert_allclose(at_time(car, 2.0, np.array([20.0, -10, 1]), reach_m=1.0).centre, [[20, -10, 1]])
    for time, near, count in ((2.0, 0.0, 0), (0.0, 0.0, 1), (3.0, 30.0, 0), (2.9, 29.0, 1)):  # `until` is excluded
        assert len(at_time(car, time, np.array([near, -near / 2, 1]), reach_m=15.0).label) == count
    wall = shapes((0, 100, 0, 50, 45, 2, 0, 50), (0, 100, 0, 1, 1, 2, 0, 80))
    np.testing.assert_array_equal(at_time(wall, 0.0, np.zeros(3), reach_m=60.0).label, [50])  # reach to the shape
    assert len(at_time(NOTHING, 0.0, np.zeros(3), reach_m=60.0).label) == 0
