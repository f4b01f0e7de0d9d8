"""Images that were compressed come back, in less memory."""

import numpy as np
import pytest
from scenes import place, seen_from

from sglpr_jax.loops import keyframes
from sglpr_jax.loops.keyframes import StoredScans
from sglpr_jax.registration.bev_spectra import match_spectra
from sglpr_jax.retrieval.index import Index


def images(count: int) -> list[np.ndarray]:
    """Sparse images of one place."""
    return [seen_from(place(), (0.1 * k, 0.0, 0.0), seed=k).astype(np.uint8) for k in range(count)]


def test_images_come_back_in_a_fraction_of_the_memory():
    stored, given = StoredScans(Index.empty(4)), images(40)
    for k, image in enumerate(given):
        stored.add(10 * k, np.full(4, k, np.float32), image)
    for k, image in enumerate(given):
        np.testing.assert_array_equal(stored.image(k), image)
    assert len(stored) == 40 and stored.frames.tolist() == list(range(0, 400, 10))
    empty = StoredScans(Index.empty(4))
    empty.add(0, np.zeros(4, np.float32), given[0])
    assert stored.nbytes - empty.nbytes < 40 * given[0].nbytes / 3


def test_an_image_of_another_size_is_one_clear_error():
    stored = StoredScans(Index.empty(4))
    stored.add(0, np.zeros(4, np.float32), images(1)[0])
    with pytest.raises(ValueError, match=r"frame 3: expected an image of \(64, 64\) cells, found \(8, 8\)"):
        stored.add(3, np.zeros(4, np.float32), np.zeros((8, 8), np.uint8))
    assert len(stored) == 1 == len(stored.index)


def test_spectra_are_those_of_the_images_and_only_the_last_used_are_kept(monkeypatch):
    monkeypatch.setattr(keyframes, "SPECTRA", 3)
    stored, given = StoredScans(Index.empty(4)), images(5)
    for k, image in enumerate(given):
        stored.add(10 * k, np.full(4, k, np.float32), image)
    expected = np.asarray(match_spectra(np.stack(given)))
    for rows in ([0, 1, 2, 3, 4], [4, 0], [1]):
        np.testing.assert_allclose(np.stack(stored.spectra(np.array(rows))), expected[rows], atol=1e-5)
        assert len(stored._spectra) == 3
    stored.forget(2)
    np.testing.assert_allclose(np.stack(stored.spectra(np.array([0, 2]))), expected[[2, 4]], atol=1e-5)
