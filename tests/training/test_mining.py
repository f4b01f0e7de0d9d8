"""A descriptor cache is made when it is due, kept as long as a checkpoint may ask for it, and read back to the bit."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.training.mining import DescriptorCache, Mining
from sglpr_jax.training.step import TrainState

PLACES = 30


MINED = TupleConfig(negatives=2, mining="hardest", refresh_steps=4)
"""Every 4 steps, with a checkpoint every 2."""


def described_by(state: TrainState, places: np.ndarray) -> np.ndarray:
    """Descriptors that differ with the weights, here a number."""
    return np.outer(places + 1, [state.params, 1]).astype(np.float32)


def weights(number: float) -> TrainState:
    return TrainState(0, number, {})


def mining_in(folder, *, config: TupleConfig = MINED, checkpoints=list) -> Mining:
    return Mining(described_by, PLACES, config, folder, seed=0, checkpoints=checkpoints)


def test_the_cache_is_that_of_the_weights_at_the_last_refresh(tmp_path):
    mining = mining_in(tmp_path)
    assert mining.cache is None
    mining.refresh(8, weights(0.5))
    np.testing.assert_array_equal(mining.cache.places, np.arange(PLACES))
    np.testing.assert_array_equal(mining.cache.descriptors, described_by(weights(0.5), np.arange(PLACES)))

    resumed = mining_in(tmp_path)
    resumed.refresh(11, weights(7.0))  # of a later step: what counts are the weights of step 8
    np.testing.assert_array_equal(resumed.cache.descriptors, mining.cache.descriptors)
    with pytest.raises(FileNotFoundError, match=r"12\.npz: expected descriptors of places"):
        resumed.refresh(13, weights(7.0))


def test_some_places_are_others_each_time_and_the_same_for_the_same_step(tmp_path):
    some = dataclasses.replace(MINED, mined_places=10)
    places = []
    for folder, step in (("a", 4), ("b", 4), ("a", 8)):
        mining = mining_in(tmp_path / folder, config=some)
        mining.refresh(step, weights(1.0))
        places.append(mining.cache.places.tolist())
    assert places[0] == places[1] != places[2]
    assert all(len(set(each)) == 10 and each == sorted(each) for each in places)


def test_caches_that_no_checkpoint_can_need_are_removed(tmp_path):
    kept: list[int] = []
    mining = mining_in(tmp_path, checkpoints=lambda: kept)
    for step in range(0, 29, 4):
        kept[:] = [step - 6, step - 4] if step > 8 else []  # newer ones are on their way
        mining.refresh(step, weights(step))
    # At step 28 the checkpoints are those of steps 22 and 24.
    assert sorted(int(path.stem) for path in tmp_path.iterdir()) == [20, 24, 28]


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
