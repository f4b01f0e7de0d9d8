"""A descriptor cache is computed at refresh steps, kept while a checkpoint needs it, and read bit by bit."""

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.training.mining import DescriptorCache, refresh_cache

PLACES = 30


def refreshed(folder, step: int, weight: float, *, mined_places: int = 0) -> DescriptorCache:
    """The cache of a step, refreshed every 4 steps, of descriptors that depend on one weight."""
    config = TupleConfig(negatives=2, mining="hardest", refresh_steps=4, mined_places=mined_places)
    return refresh_cache(step, functools.partial(describe, weight), PLACES, config, folder, seed=0)


def describe(weight: float, places: np.ndarray) -> np.ndarray:
    return np.outer(places + 1, [weight, 1]).astype(np.float32)


def test_the_cache_has_the_descriptors_of_the_last_refresh(tmp_path):
    cache = refreshed(tmp_path, 8, 0.5)
    np.testing.assert_array_equal(cache.places, np.arange(PLACES))
    np.testing.assert_array_equal(cache.descriptors, describe(0.5, np.arange(PLACES)))
    resumed = refreshed(tmp_path, 11, 7.0)  # with later weights
    np.testing.assert_array_equal(resumed.descriptors, cache.descriptors)
    with pytest.raises(FileNotFoundError, match=r"12\.npz: expected descriptors of places"):
        refreshed(tmp_path, 13, 7.0)


def test_the_selected_places_depend_on_the_step_alone(tmp_path):
    runs = (("a", 4), ("b", 4), ("a", 8))
    places = [refreshed(tmp_path / run, step, 1.0, mined_places=10).places.tolist() for run, step in runs]
    assert places[0] == places[1] != places[2]
    assert all(len(set(rows)) == 10 and rows == sorted(rows) for rows in places)


def test_caches_that_no_checkpoint_needs_are_removed(tmp_path):
    for step in range(0, 29, 4):
        if step > 8:  # checkpoints every 2 steps, of which two are kept
            for saved in (step - 6, step - 4):
                (tmp_path / f"checkpoints/{saved}").mkdir(parents=True, exist_ok=True)
            for saved in (step - 10, step - 8):
                (tmp_path / f"checkpoints/{saved}").rmdir() if step > 12 else None
        refreshed(tmp_path, step, step)
    assert sorted(int(path.stem) for path in (tmp_path / "mining").iterdir()) == [20, 24, 28]


def cache_of(places: np.ndarray, seed: int = 0) -> DescriptorCache:
    return DescriptorCache(places, np.random.default_rng(seed).normal(size=(len(places), 5)).astype(np.float32))


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10**6), size=st.integers(1, 12))
def test_nearest_equals_brute_force(seed, size):
    rng = np.random.default_rng(seed)
    cache = cache_of(np.sort(rng.choice(100, 40, replace=False)), seed)
    candidates = np.sort(rng.choice(100, 30, replace=False))
    anchor = int(rng.choice(cache.places))
    by_place = dict(zip(cache.places.tolist(), cache.descriptors, strict=True))
    known = [place for place in candidates.tolist() if place in by_place]
    expected = sorted(known, key=lambda place: np.square(by_place[place] - by_place[anchor]).sum())[:size]
    np.testing.assert_array_equal(cache.nearest(anchor, candidates, size), expected)


def test_a_place_that_was_not_described_has_no_nearest_place():
    assert cache_of(np.array([1, 4, 6])).nearest(5, np.array([1, 4]), 2).tolist() == []


def test_a_cache_file_is_read_completely_or_refused(tmp_path):
    cache, path = cache_of(np.array([2, 3, 9])), tmp_path / "40.npz"
    cache.save(path)
    found = DescriptorCache.load(path)
    np.testing.assert_array_equal(found.places, cache.places)
    np.testing.assert_array_equal(found.descriptors, cache.descriptors)
    assert found.descriptors.dtype == np.float32 and [file.name for file in tmp_path.iterdir()] == ["40.npz"]
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ValueError, match=r"40\.npz: expected descriptors of places"):
        DescriptorCache.load(path)
    with pytest.raises(FileNotFoundError, match=r"41\.npz"):
        DescriptorCache.load(tmp_path / "41.npz")
