"""Batches are read ahead in order, but not past a refresh. Errors are raised when due, and no thread remains."""

import threading

import pytest

from sglpr_jax.training.batch_source import batches_in_order, read_ahead
from sglpr_jax.training.batches import Batch
from sglpr_jax.training.step import TrainState

from .conftest import Made

TIMEOUT_S = 10
STATE = TrainState(0, {}, {})


def reading_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("read-ahead")]


@pytest.fixture(autouse=True)
def no_thread_is_left():
    yield
    assert reading_threads() == []


@pytest.mark.parametrize("depth", [1, 5])
def test_values_are_yielded_in_order(depth):
    assert list(read_ahead(lambda step: step * step, start=3, stop=20, depth=depth)) == [i * i for i in range(3, 20)]


def test_an_error_is_raised_when_its_value_is_due():
    def make(step):
        if step == 3:
            raise OSError("scan 3 is broken")
        return step

    items = read_ahead(make, start=0, stop=10)
    assert [next(items) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(OSError, match="scan 3 is broken"):
        next(items)


def test_closing_ends_the_thread_although_the_queue_is_full():
    made = []
    items = read_ahead(lambda step: made.append(step), start=0, stop=10**6, depth=2)
    next(items)
    assert len(reading_threads()) == 1
    items.close()
    assert reading_threads() == []
    assert len(made) <= 1 + 2 + 1  # taken, queued, and one that found no place


def test_batches_are_never_read_past_a_refresh():
    refreshed, made = [], []

    def make(step: int) -> Batch:
        made.append(step)
        return Batch(labelled=step, negatives=refreshed[-1], positives=1)

    source = Made(make)
    source.refresh_steps, source.refresh = 4, lambda step, params: refreshed.append(step)
    batches = batches_in_order(source, lambda: STATE, start=3, stop=11)
    found = [(batch.labelled, batch.negatives) for batch in batches]
    assert refreshed == [3, 4, 8] and made == list(range(3, 11))
    assert found == [(3, 3), (4, 4), (5, 4), (6, 4), (7, 4), (8, 8), (9, 8), (10, 8)]
