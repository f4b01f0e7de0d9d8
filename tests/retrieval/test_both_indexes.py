"""Answers of the index in memory, and places that it refuses."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from sglpr_jax import Index

from .places import WIDTH, add_places, draw, file_of

New = Callable[..., Index]


@pytest.fixture
def new() -> New:
    """`new(weights_hash=...)` is an empty index."""
    return lambda **about: Index.empty(WIDTH, **about)


def test_equal_places_come_in_their_order_and_one_descriptor_gives_one_answer(new: New):
    index = new()
    index.add(np.repeat(draw(2), 20, axis=0))
    found = index.query(draw(2)[1], 3)
    assert found.rows.tolist() == [20, 21, 22] and found.distances.tolist() == [0, 0, 0]


def test_recent_places_are_left_out_by_time_or_by_number(new: New):
    index = new()
    add_places(index, 100)  # one each half second
    assert np.flatnonzero(index.recent(50.0)).tolist() == list(range(41, 100))
    assert np.flatnonzero(index.recent(frames=3)).tolist() == [97, 98, 99]
    assert index.query(draw(100)[99], 1, exclude=index.recent(50.0)).rows[0] <= 40


def test_no_places_begin_no_times(new: New):
    index = new()
    index.add(np.zeros((0, WIDTH)), times=np.zeros(0))
    index.add(draw(10))
    assert index.recent(50.0, frames=4).sum() == 4


def test_without_times_recent_places_are_left_out_by_number(new: New):
    index = new()
    index.add(draw(10))
    assert index.recent(50.0, frames=4).sum() == 4


def test_an_empty_index_has_no_answers(new: New):
    index = new()
    assert len(index) == 0 and list(index.ids) == [] and index.times is None and index.positions is None
    assert index.query(draw(1)[0], 2).rows.tolist() == [-1, -1]


def test_descriptors_of_another_model_are_refused(new: New):
    index = new(weights_hash="abc")
    add_places(index, 5)
    for refused in (
        lambda: index.add(draw(1), weights_hash="xyz"),
        lambda: index.query(draw(1), weights_hash="xyz"),
        lambda: index.add_file(file_of(3, weights_hash="xyz")),
    ):
        with pytest.raises(ValueError, match="expected descriptors of the weights abc, found those of xyz"):
            refused()
    with pytest.raises(ValueError, match="expected scale 1, found scale 2"):
        index.add_file(dataclasses.replace(file_of(3), config={"scale": 2}))
    with pytest.raises(ValueError, match="compared by l2, found cosine"):
        index.add_file(dataclasses.replace(file_of(3, weights_hash="abc"), distance="cosine"))
    with pytest.raises(ValueError, match=r"shape \(1, 8\), found \(1, 9\)"):
        index.query(np.zeros((1, 9), np.float32))


def test_a_descriptor_file_is_added(new: New):
    index = new(weights_hash="abc")
    index.add_file(file_of(7))
    assert list(index.ids) == list(file_of(7).ids) and index.positions is None
    np.testing.assert_array_equal(index.times, file_of(7).times)


def test_what_does_not_fit_is_refused_and_changes_nothing(new: New):
    index = new()
    add_places(index, 5)
    for wrong, message in (
        ({"times": np.zeros(1)}, "expected places with descriptors, times, positions"),
        ({"times": np.zeros(2), "positions": np.zeros((1, 3))}, "times of shape"),
        ({"times": np.array([np.nan]), "positions": np.zeros((1, 3))}, "finite times"),
        ({"ids": ("a", "b")}, "expected 1 ids"),
    ):
        with pytest.raises(ValueError, match=message):
            index.add(draw(1), **wrong)
    with pytest.raises(ValueError, match="finite descriptors"):
        index.query(np.full(WIDTH, np.nan, np.float32))
    with pytest.raises(ValueError, match="k of 1 or more"):
        index.query(draw(1), 0)
    with pytest.raises(ValueError, match="expected k up to 1048576, found 1000000000"):
        index.query(draw(1), 10**9)
    with pytest.raises(ValueError, match="expected at most 64 queries at a time for k = 1048576, found 65"):
        index.query(draw(65), 2**20)
    with pytest.raises(ValueError, match="one flag for each of 5"):
        index.query(draw(1), exclude=np.zeros(6, bool))
    assert len(index) == 5
