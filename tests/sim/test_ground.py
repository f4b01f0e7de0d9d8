"""The hills against finite differences, and the raster."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from surfaces import FLAT, HILLS, striped_ground

from sglpr_jax.sim.ground import (
    CELL_M,
    KERB_M,
    Ground,
    Relief,
    draw_relief,
    ground_view,
    label_at,
    meet_ground,
    relief_curvature,
    relief_gradient,
    relief_height,
    surface_height,
)
from sglpr_jax.sim.labels import ROAD, SIDEWALK, TERRAIN
from sglpr_jax.sim.shapes import Vectors

STEP = 1e-3


def places(seed: int, count: int = 50) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1000, 1000, (count, 2))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_gradient_and_curvature_are_the_heights_derivatives(seed):
    relief, xy = draw_relief(np.random.default_rng(seed)), places(seed)
    for axis, step in enumerate(STEP * np.eye(2)):
        slope = (relief_height(relief, xy + step) - relief_height(relief, xy - step)) / (2 * STEP)
        np.testing.assert_allclose(relief_gradient(relief, xy)[:, axis], slope, atol=1e-8)
        bend = (relief_gradient(relief, xy + step) - relief_gradient(relief, xy - step)) / (2 * STEP)
        np.testing.assert_allclose(relief_curvature(relief, xy)[:, axis], bend, atol=1e-8)


@pytest.fixture
def ground() -> Ground:
    label = np.random.default_rng(0).integers(1, 100, (60, 80)).astype(np.uint8)
    return Ground(label, np.array([-3.0, 5.0]), draw_relief(np.random.default_rng(1)))


def test_rows_are_y_and_columns_are_x(ground):
    where = ground.origin + (np.array([[7, 31]]) + 0.5) * CELL_M
    assert label_at(ground, where) == ground.label[31, 7]
    assert label_at(ground, np.array([[-500.0, 500.0]])) == ground.label[-1, 0]


REACH_M = 70.0
meet = jax.jit(lambda rays, view: meet_ground(rays, view, reach_m=REACH_M))


def rays(lowest: float = -0.5, highest: float = 0.02) -> np.ndarray:
    """Unit vectors (lasers, azimuths, 3)."""
    azimuth, slope = np.linspace(0, 2 * np.pi, 90)[None, :], np.linspace(lowest, highest, 16)[:, None]
    directions = np.stack(np.broadcast_arrays(np.cos(azimuth), np.sin(azimuth), slope), axis=-1)
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def cast(ground, sensor: np.ndarray, directions: np.ndarray):
    """Distance, label and facing per ray, and the points in the world."""
    view = ground_view(ground, sensor, reach_m=REACH_M)
    found = [np.asarray(part) for part in meet(Vectors(*np.moveaxis(directions, -1, 0).astype(np.float32)), view)]
    return *found, sensor + directions * np.where(np.isfinite(found[0]), found[0], 0)[..., None]


def sensor_over(relief: Relief, x: float, y: float) -> np.ndarray:
    return np.array([x, y, relief_height(relief, np.array([x, y], float)) + 1.73])


@settings(max_examples=20, deadline=None)
@given(st.floats(-25, 25), st.floats(-25, 25), st.sampled_from([FLAT, HILLS]))
def test_points_lie_on_the_ground_and_bear_its_label(x, y, relief):
    ground = striped_ground(relief, ROAD, TERRAIN)
    distance, label, _, points = cast(ground, sensor_over(relief, x, y), rays())
    for reach, tolerance in ((20, 0.01), (60, 0.1)):
        near = (distance < reach) & (np.abs(points[..., 1]) > 0.3)
        assert near.sum() > 200
        error = np.abs(points[near][:, 2] - surface_height(ground, points[near][:, :2]))
        # A flat ray along the kerb into its face may be given metres behind it, that is below the surface.
        assert np.mean(error < tolerance) > 0.98 and error.max() < KERB_M + tolerance
        np.testing.assert_array_equal(label[near], np.where(points[near][:, 1] > 0, ROAD, TERRAIN))


def test_a_kerb_hides_nothing_and_its_face_is_the_sidewalk():
    ground = striped_ground(FLAT, ROAD, SIDEWALK)  # the kerb runs along y = 0
    down = np.linspace(-0.43, -0.2, 300)
    towards = np.stack([np.zeros(300), -np.ones(300), down], axis=-1)
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    _, label, _, points = cast(ground, np.array([0, 5.0, 1.73]), towards[None])
    on_road, on_top, face = points[0, :, 1] > 1e-3, points[0, :, 2] > KERB_M - 1e-3, label[0] == SIDEWALK
    np.testing.assert_array_equal(face, ~on_road)
    np.testing.assert_allclose(points[0, on_top, 2], KERB_M, atol=1e-4)
    np.testing.assert_allclose(points[0, on_road, 2], 0, atol=1e-4)
    on_face = ~on_road & ~on_top
    # A ray into the face is given where it would meet the road behind it: some centimetres too far.
    assert on_face.sum() > 2 and np.all(points[0, on_face, 1] > -0.5)


@pytest.mark.parametrize("relief", [FLAT, HILLS])
def test_facing_is_the_cosine_to_the_normal(relief):
    ground, directions = striped_ground(relief, ROAD, ROAD), rays()
    distance, _, facing, points = cast(ground, sensor_over(relief, 3, 4), directions)
    gradient = relief_gradient(relief, points[..., :2])
    normal = np.concatenate([-gradient, np.ones((*gradient.shape[:-1], 1))], axis=-1)
    expected = -np.sum(directions * normal, axis=-1) / np.linalg.norm(normal, axis=-1)
    near = distance < 30
    np.testing.assert_allclose(facing[near], expected[near], atol=5e-3)
