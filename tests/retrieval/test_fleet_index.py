"""The index on LanceDB answers as the one in memory does, comes back from its folder, and refuses the same things."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax import Index
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.fleet_index import FORMAT, TABLE, FleetIndex, _runs

WIDTH = 8


def draw(n: int, seed: int = 0) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(n, WIDTH)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def filled(folder: Path, n: int, **about) -> FleetIndex:
    index = FleetIndex(folder, width=WIDTH, **about)
    index.add(draw(n), times=np.arange(n) / 2, positions=np.arange(3.0 * n).reshape(n, 3))
    return index


def assert_same(found, expected):
    np.testing.assert_array_equal(found.rows, expected.rows)
    np.testing.assert_allclose(found.distances, expected.distances)


@pytest.mark.parametrize(("n", "parts"), [(3, 1), (400, 1), (400, 7)])
@pytest.mark.parametrize("k", [1, 20])
def test_the_answers_are_those_of_the_exact_index(tmp_path, n, parts, k):
    fleet, exact = FleetIndex(tmp_path, width=WIDTH), Index.empty(WIDTH)
    for part in np.array_split(draw(n), parts):
        fleet.add(part)
        exact.add(part)
    queries = np.concatenate([draw(4, seed=1), draw(n)[:2]])
    assert_same(fleet.query(queries, k), exact.query(queries, k))
    assert_same(fleet.query(queries[0], k), exact.query(queries[0], k))
    for share in (0.1, 0.9, 1.0):
        left_out = np.random.default_rng(n).random(n) < share
        assert_same(fleet.query(queries, k, exclude=left_out), exact.query(queries, k, exclude=left_out))
    assert fleet.ids == exact.ids and len(fleet) == n


def test_equal_places_come_in_their_order(tmp_path):
    index = FleetIndex(tmp_path, width=WIDTH)
    index.add(np.repeat(draw(2), 8, axis=0))
    found = index.query(draw(2)[1], 3)
    assert found.rows.tolist() == [8, 9, 10] and found.distances.tolist() == [0, 0, 0]


def test_recent_places_are_left_out_by_time_or_by_number(tmp_path):
    index = filled(tmp_path, 100)  # a place each half second
    assert np.flatnonzero(index.recent(50.0)).tolist() == list(range(41, 100))
    assert np.flatnonzero(index.recent(frames=3)).tolist() == [97, 98, 99]
    assert index.query(draw(100)[99], 1, exclude=index.recent(50.0)).rows[0] <= 40


def test_it_comes_back_from_its_folder_and_others_see_what_is_added(tmp_path):
    index = filled(tmp_path, 30, weights_hash="abc")
    again = FleetIndex(tmp_path, width=WIDTH)
    assert again.weights_hash == "abc" and again.ids == index.ids
    np.testing.assert_array_equal(again.times, np.arange(30) / 2)
    np.testing.assert_array_equal(again.positions, np.arange(90.0).reshape(30, 3))
    again.add(draw(1, seed=9)[0], ids="new", times=16.0, positions=np.zeros(3))
    assert index.query(draw(1, seed=9)[0]).rows.tolist() == [30] and index.ids[-1] == "new" and len(index) == 31


def test_an_empty_index_has_no_answers(tmp_path):
    index = FleetIndex(tmp_path, width=WIDTH)
    assert len(index) == 0 and index.ids == [] and index.times is None and index.positions is None
    assert index.query(draw(1)[0], 2).rows.tolist() == [-1, -1]


def test_descriptors_of_another_model_are_refused(tmp_path):
    index = filled(tmp_path, 5, weights_hash="abc")
    for refused in (
        lambda: index.add(draw(1), weights_hash="xyz"),
        lambda: index.query(draw(1), weights_hash="xyz"),
        lambda: FleetIndex(tmp_path, width=WIDTH, weights_hash="xyz"),
        lambda: index.add_file(file_of(3, weights_hash="xyz")),
    ):
        with pytest.raises(ValueError, match="expected descriptors of the weights abc, found those of xyz"):
            refused()
    with pytest.raises(ValueError, match="compared by l2, found cosine"):
        index.add_file(dataclasses.replace(file_of(3, weights_hash="abc"), distance="cosine"))
    with pytest.raises(ValueError, match="expected descriptors of 9 numbers, found 8"):
        FleetIndex(tmp_path, width=9)


def test_a_descriptor_file_is_added(tmp_path):
    index = FleetIndex(tmp_path, width=WIDTH, weights_hash="abc")
    index.add_file(file_of(7))
    assert index.ids == list(file_of(7).ids) and index.positions is None
    np.testing.assert_array_equal(index.times, file_of(7).times)


def test_what_does_not_fit_is_refused_and_changes_nothing(tmp_path):
    index = filled(tmp_path, 5)
    for wrong, message in (
        ({"times": np.zeros(1)}, "expected places with descriptors, times, positions"),
        ({"times": np.array([np.nan]), "positions": np.zeros((1, 3))}, "finite times"),
        ({"ids": ("a", "b")}, "expected 1 ids"),
    ):
        with pytest.raises(ValueError, match=message):
            index.add(draw(1), **wrong)
    with pytest.raises(ValueError, match="k of 1 or more"):
        index.query(draw(1), 0)
    with pytest.raises(ValueError, match="one flag for each of 5"):
        index.query(draw(1), exclude=np.zeros(4, bool))
    assert len(index) == 5


def test_other_tables_and_broken_ones_are_refused(tmp_path):
    index = filled(tmp_path / "broken", 5)
    index._connection.create_table("mine", [{"x": 1}])
    for file in (tmp_path / "broken" / f"{TABLE}.lance" / "_versions").iterdir():
        file.write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"broken: expected an index of LanceDB, found a broken one"):
        FleetIndex(tmp_path / "broken", width=WIDTH)
    other = FleetIndex(tmp_path / "other", width=WIDTH)
    other._connection.create_table(TABLE, [{"x": 1}])
    with pytest.raises(ValueError, match=f"other: expected format '{FORMAT}', found None"):
        FleetIndex(tmp_path / "other", width=WIDTH)


def test_without_the_extra_it_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lancedb", None)
    with pytest.raises(ImportError, match=r"needs the extra `fleet`"):
        FleetIndex(tmp_path)


@settings(deadline=None)
@given(flags=st.lists(st.booleans(), max_size=30))
def test_runs_are_all_set_flags(flags):
    rows = [row for first, last in _runs(np.array(flags, bool)) for row in range(first, last + 1)]
    assert rows == np.flatnonzero(np.array(flags, bool)).tolist()


def file_of(n: int, *, weights_hash: str = "abc") -> DescriptorFile:
    return DescriptorFile(
        sequence="00",
        ids=tuple(f"frame{i}" for i in range(n)),
        positions=None,
        times=np.arange(n) / 2,
        descriptors=draw(n),
        pose_source=None,
        config={},
        weights_hash=weights_hash,
    )
