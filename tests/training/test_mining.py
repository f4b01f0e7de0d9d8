"""A descriptor cache is made when it is due, kept as long as a checkpoint may ask for it, and read back to the bit."""

import dataclasses

import numpy as np
import pytest

from sglpr_jax.data.sampling.batch import Batch
from sglpr_jax.data.sampling.config import TupleConfig
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.params import Params
from sglpr_jax.training.batch_queue import BatchQueue
from sglpr_jax.training.mining import Mining

from .conftest import Made

PLACES = 30


@pytest.fixture
def mined(config):
    """Every 4 steps, a checkpoint every 2."""
    return dataclasses.replace(config, sampling=TupleConfig(negatives=2, mining="hardest", refresh_steps=4))


def described_by(params: Params, places: np.ndarray) -> np.ndarray:
    """Descriptors that differ with the weights, here a number."""
    return np.outer(places + 1, [params.weights, 1]).astype(np.float32)


def weights(number: float) -> Params:
    return Params(number, ModelConfig())


def test_the_cache_is_that_of_the_weights_at_the_last_refresh(mined, tmp_path):
    mining = Mining(described_by, PLACES, mined, tmp_path, checkpoints=list)
    assert mining.cache is None
    mining.refresh(8, weights(0.5))
    np.testing.assert_array_equal(mining.cache.places, np.arange(PLACES))
    np.testing.assert_array_equal(mining.cache.descriptors, described_by(weights(0.5), np.arange(PLACES)))

    resumed = Mining(described_by, PLACES, mined, tmp_path, checkpoints=list)
    resumed.refresh(11, weights(7.0))  # of a later step: what counts are the weights of step 8
    np.testing.assert_array_equal(resumed.cache.descriptors, mining.cache.descriptors)
    with pytest.raises(FileNotFoundError, match=r"12\.npz: expected descriptors of places"):
        resumed.refresh(13, weights(7.0))


def test_some_places_are_others_each_time_and_the_same_for_the_same_step(mined, tmp_path):
    some = dataclasses.replace(mined, sampling=dataclasses.replace(mined.sampling, mined_places=10))
    places = []
    for folder, step in (("a", 4), ("b", 4), ("a", 8)):
        mining = Mining(described_by, PLACES, some, tmp_path / folder, checkpoints=list)
        mining.refresh(step, weights(1.0))
        places.append(mining.cache.places.tolist())
    assert places[0] == places[1] != places[2]
    assert all(len(set(each)) == 10 and each == sorted(each) for each in places)


def test_caches_that_no_checkpoint_can_need_are_removed(mined, tmp_path):
    kept: list[int] = []
    mining = Mining(described_by, PLACES, mined, tmp_path, checkpoints=lambda: kept)
    for step in range(0, 29, 4):
        kept[:] = [6, step - 6, step - 4] if step > 8 else []  # that of step 6 is the best; newer ones are on their way
        mining.refresh(step, weights(step))
    # At step 28 the checkpoints are those of steps 6, 22 and 24.
    assert sorted(int(path.stem) for path in tmp_path.iterdir()) == [4, 20, 24, 28]


def test_a_run_goes_on_from_its_best_checkpoint_however_old(mined, tmp_path):
    mining = Mining(described_by, PLACES, mined, tmp_path, checkpoints=lambda: [6, 38, 40])
    for step in range(0, 41, 4):
        mining.refresh(step, weights(step))
    resumed = Mining(described_by, PLACES, mined, tmp_path, checkpoints=lambda: [6])
    resumed.refresh(6, weights(7.0))
    np.testing.assert_array_equal(resumed.cache.descriptors, described_by(weights(4), np.arange(PLACES)))
    resumed.refresh(8, weights(8.0))
    np.testing.assert_array_equal(resumed.cache.descriptors, described_by(weights(8), np.arange(PLACES)))


def test_batches_are_never_read_past_a_refresh():
    refreshed, made = [], []

    def make(step: int) -> Batch:
        made.append(step)
        return Batch(labelled=step, negatives=refreshed[-1], positives=1)

    source = Made(make)
    source.refresh_steps, source.refresh = 4, lambda step, params: refreshed.append(step)
    batches = BatchQueue(source, start=3, stop=11)
    found = []
    for _ in range(3, 11):
        batches.prepare(weights(0))
        batch = next(batches)
        found.append((batch.labelled, batch.negatives))
    batches.close()
    assert refreshed == [3, 4, 8] and made == list(range(3, 11))
    assert found == [(3, 3), (4, 4), (5, 4), (6, 4), (7, 4), (8, 8), (9, 8), (10, 8)]


def test_without_a_refresh_batches_are_read_as_they_come():
    batches = BatchQueue(Made(lambda step: Batch(step, None, 1)), start=2, stop=5)
    found = []
    for _ in range(3):
        batches.prepare(weights(0))
        found.append(next(batches).labelled)
    batches.close()
    assert found == [2, 3, 4]
