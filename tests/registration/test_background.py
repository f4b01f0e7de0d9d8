"""Rings, and the cells that all images of a moving sensor have in common, are not compared."""

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.models.params import Params
from sglpr_jax.registration import background as background_module
from sglpr_jax.registration.background import Background, ring_medians

CELLS, CELL_M, RINGS_M = 152, 0.4, (4.0, 6.0, 9.0, 13.0)
RING_COUNT = 80


@pytest.mark.parametrize("size", [4, 9])
def test_the_median_of_each_ring_is_that_of_its_cells(size):
    image = np.random.default_rng(0).random((size, size)).astype(np.float32)
    axis = np.arange(size) - (size - 1) / 2
    ring = np.floor(np.hypot(axis[:, None], axis[None]))
    expected = [[np.median(image[ring == ring[i, j]]) for j in range(size)] for i in range(size)]
    np.testing.assert_array_equal(ring_medians(image), np.array(expected, np.float32))


def test_the_average_is_the_mean_and_then_forgets(monkeypatch):
    monkeypatch.setattr(background_module, "ring_medians", np.zeros_like)
    images = np.random.default_rng(0).integers(0, 256, (6, 4, 4)).astype(np.uint8)
    monkeypatch.setattr(background_module, "FRAMES", 3)
    monkeypatch.setattr(background_module, "MIN_FRAMES", 2)
    background, roots = Background(), np.sqrt(images.astype(np.float64))
    expected = roots[0]
    for k, (image, root) in enumerate(zip(images, roots, strict=True)):
        expected = expected + (root - expected) / min(k + 1, 3)
        background.add(image)
        found = background.without(images[0])
        wanted = np.round(np.maximum(roots[0] - expected, 0) ** 2) if k else images[0]
        np.testing.assert_allclose(found, wanted, atol=1)  # float32 roots round at a half
        if k == 2:
            np.testing.assert_allclose(expected, roots[:3].mean(axis=0))


@pytest.mark.slow
def test_rings_do_not_hold_the_motion(monkeypatch):
    params, posts = sglpr_jax.load("circular"), np.random.default_rng(0).uniform(-60, 60, (200, 2))
    assert 24 < _moved(params, posts) < 31  # by the average, too: the first steps may be lost
    monkeypatch.setattr(background_module, "MIN_FRAMES", 10_000)
    assert 28 < _moved(params, posts) < 30
    monkeypatch.setattr(background_module, "ring_medians", np.zeros_like)
    assert _moved(params, posts) < 1  # the reference: where rings are compared, the motion stands still


def _moved(params: Params, posts: np.ndarray) -> float:
    """How far the motion moved, in metres, over 29 m."""
    finder = CandidateFinder(params, DetectorConfig(keyframe_m=0.0))
    descriptor = np.zeros(finder.index.width, np.float32)
    for k in range(30):
        finder.add_seen(Seen(descriptor, _image(posts - (k, 0.0)), None), time=0.1 * k)
    return float(np.linalg.norm(finder.motion.poses[-1][:3, 3]))


def _image(posts: np.ndarray) -> np.ndarray:
    """Posts about a sensor, and rings on the floor."""
    axis = (np.arange(CELLS) - (CELLS - 1) / 2) * CELL_M
    radius = np.hypot(axis[:, None], axis[None])
    image = np.where((np.abs(radius[..., None] - RINGS_M) < 0.2).any(axis=-1), RING_COUNT, 0)
    apart = np.hypot(axis[:, None, None] - posts[:, 0], axis[None, :, None] - posts[:, 1]).min(axis=-1)
    return np.where(apart < 0.5, 160, image).astype(np.uint8)
