"""Rings, and the cells that all images of a moving sensor have in common, are not compared."""

import numpy as np
import pytest

from sglpr_jax.registration import background as background_module
from sglpr_jax.registration.background import Background, ring_medians


@pytest.mark.parametrize("size", [4, 9])
def test_the_median_of_each_ring_is_that_of_its_cells(size):
    image = np.random.default_rng(0).integers(0, 256, (size, size)).astype(np.uint8)
    axis = np.arange(size) - (size - 1) / 2
    ring = np.floor(np.hypot(axis[:, None], axis[None]))
    root = np.sqrt(image, dtype=np.float32)
    expected = [[np.median(root[ring == ring[i, j]]) for j in range(size)] for i in range(size)]
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
