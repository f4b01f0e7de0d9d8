"""Nearest by descriptor is what brute force says, and a file comes back to the bit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.data.sampling.descriptor_cache import DescriptorCache


def cache_of(places: np.ndarray, seed: int = 0) -> DescriptorCache:
    return DescriptorCache(places, np.random.default_rng(seed).normal(size=(len(places), 5)).astype(np.float32))


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10**6), size=st.integers(1, 12))
def test_the_nearest_are_those_of_brute_force(seed, size):
    rng = np.random.default_rng(seed)
    cache = cache_of(np.sort(rng.choice(100, 40, replace=False)), seed)
    candidates = np.sort(rng.choice(100, 30, replace=False))
    anchor = int(rng.choice(cache.places))
    by_place = dict(zip(cache.places.tolist(), cache.descriptors, strict=True))
    known = [place for place in candidates.tolist() if place in by_place]
    expected = sorted(known, key=lambda place: np.square(by_place[place] - by_place[anchor]).sum())[:size]
    np.testing.assert_array_equal(cache.nearest(anchor, candidates, size), expected)


def test_nothing_is_near_a_place_that_was_not_described():
    cache = cache_of(np.array([1, 4, 6]))
    assert cache.nearest(5, np.array([1, 4]), 2).tolist() == []
    assert set(cache.nearest(4, np.array([0, 1, 6]), 5).tolist()) == {1, 6}


def test_a_file_comes_back_whole_or_is_refused(tmp_path):
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
