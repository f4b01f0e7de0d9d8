"""The hills against finite differences, and the raster."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.sim.ground import (
    CELL_M,
    KERB_M,
    Ground,
    draw_relief,
    is_raised,
    label_at,
    relief_curvature,
    relief_gradient,
    relief_height,
    surface_height,
)
from sglpr_jax.sim.raw_ids import LANE_MARKING, OTHER_GROUND, PARKING, ROAD, SIDEWALK, TERRAIN
from sglpr_jax.sim.scenery import SCENERIES

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


@pytest.mark.parametrize("scenery", SCENERIES.values(), ids=SCENERIES)
def test_slopes_are_those_of_the_scenery_and_hills_differ(scenery):
    steepest = []
    for seed in range(20):
        relief = draw_relief(np.random.default_rng(seed), scenery)
        slope = np.linalg.norm(relief_gradient(relief, places(seed, 500)), axis=1)
        steepest.append(slope.max() / scenery.steepest)
    assert 0.6 < max(steepest) <= 1 and min(steepest) < 0.4


def test_the_shape_of_the_places_is_kept():
    relief = draw_relief(np.random.default_rng(0))
    xy = places(0, 6).reshape(2, 3, 2)
    assert relief_height(relief, xy).shape == (2, 3)
    assert relief_gradient(relief, xy).shape == (2, 3, 2) and relief_curvature(relief, xy).shape == (2, 3, 2, 2)
    np.testing.assert_allclose(relief_height(relief, xy[1, 2]), relief_height(relief, xy)[1, 2])


@pytest.fixture
def ground() -> Ground:
    label = np.random.default_rng(0).integers(1, 100, (60, 80)).astype(np.uint8)
    return Ground(label, np.array([-3.0, 5.0]), draw_relief(np.random.default_rng(1)))


def test_rows_are_y_and_columns_are_x(ground):
    where = ground.origin + (np.array([[7, 31]]) + 0.5) * CELL_M
    assert label_at(ground, where) == ground.label[31, 7]
    assert label_at(ground, np.array([[-500.0, 500.0]])) == ground.label[-1, 0]


def test_a_window_shows_the_same_ground_and_its_edge_goes_on(ground):
    centre = ground.origin + 4.0
    window = ground.around(centre, 2.0)
    xy = centre + np.random.default_rng(2).uniform(-1.9, 1.9, (100, 2))
    np.testing.assert_array_equal(label_at(window, xy), label_at(ground, xy))
    far = ground.around(np.array([-900.0, -900.0]), 2.0)
    assert far.label.shape == window.label.shape
    assert np.all(far.label == ground.label[0, 0])


def test_kerbs_rise_between_the_road_and_the_sidewalk(ground):
    labels = np.array([ROAD, PARKING, OTHER_GROUND, LANE_MARKING, SIDEWALK, TERRAIN])
    np.testing.assert_array_equal(is_raised(labels), [False, False, False, False, True, True])
    for label, kerb in ((ROAD, 0), (TERRAIN, KERB_M)):
        flat = ground._replace(label=np.full((60, 80), label, np.uint8))
        xy = places(3)
        np.testing.assert_allclose(surface_height(flat, xy), relief_height(ground.relief, xy) + kerb)
