"""Reading ahead keeps the order, passes errors on at their turn, and leaves no thread behind."""

import threading

import pytest

from sglpr_jax.data.sampling.read_ahead import read_ahead

TIMEOUT_S = 10


def reading_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "read-ahead"]


@pytest.fixture(autouse=True)
def no_thread_is_left():
    yield
    assert reading_threads() == []


@pytest.mark.parametrize("depth", [1, 2, 5])
def test_items_come_in_order(depth):
    assert list(read_ahead(lambda step: step * step, start=3, stop=20, depth=depth)) == [i * i for i in range(3, 20)]


def test_nothing_to_do_yields_nothing():
    assert list(read_ahead(lambda step: step, start=5, stop=5)) == []


def test_an_error_is_raised_at_its_turn():
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


def test_reading_runs_ahead_of_the_consumer():
    third = threading.Event()

    def make(step):
        if step == 2:
            third.set()
        return step

    items = read_ahead(make, start=0, stop=10, depth=2)
    assert next(items) == 0
    assert third.wait(TIMEOUT_S)  # made although only the first was taken
    items.close()
