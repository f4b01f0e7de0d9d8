"""The index on LanceDB answers as the one in memory does, comes back from its folder, and refuses the same things."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax import Index
from sglpr_jax.retrieval.fleet_index import FORMAT, TABLE, FleetIndex, _runs

from .places import WIDTH, add_places, draw


def filled(folder: Path, n: int, **about) -> FleetIndex:
    index = FleetIndex(folder, width=WIDTH, **about)
    add_places(index, n)
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


def test_it_comes_back_from_its_folder_and_others_see_what_is_added(tmp_path):
    index = filled(tmp_path, 30, weights_hash="abc")
    again = FleetIndex(tmp_path, width=WIDTH)
    assert again.weights_hash == "abc" and again.ids == index.ids
    np.testing.assert_array_equal(again.times, np.arange(30) / 2)
    np.testing.assert_array_equal(again.positions, np.arange(90.0).reshape(30, 3))
    again.add(draw(1, seed=9)[0], ids="new", times=16.0, positions=np.zeros(3))
    assert index.query(draw(1, seed=9)[0]).rows.tolist() == [30] and index.ids[-1] == "new" and len(index) == 31


def test_places_that_another_process_adds_meanwhile_are_not_left_out(tmp_path):
    index = filled(tmp_path, 30)
    recent = index.recent(frames=10)
    FleetIndex(tmp_path, width=WIDTH).add(draw(1, seed=9)[0], times=15.0, positions=np.zeros(3))
    rows = index.query(draw(1, seed=9)[0], 31, exclude=recent).rows
    assert rows[0] == 30 and sorted(rows[rows >= 0].tolist()) == [*range(20), 30]
    with pytest.raises(ValueError, match="one flag for each of 31 places"):
        index.query(draw(1), exclude=np.zeros(32, bool))


def test_an_index_of_another_model_is_refused(tmp_path):
    filled(tmp_path, 5, weights_hash="abc")
    with pytest.raises(ValueError, match="expected descriptors of the weights abc, found those of xyz"):
        FleetIndex(tmp_path, width=WIDTH, weights_hash="xyz")
    with pytest.raises(ValueError, match="expected descriptors of 9 numbers, found 8"):
        FleetIndex(tmp_path, width=9)


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


@pytest.mark.parametrize("size", [1, 500])
def test_data_that_are_cut_are_named_when_they_are_read(tmp_path, size):
    index = filled(tmp_path, 30)
    for file in (tmp_path / f"{TABLE}.lance" / "data").iterdir():
        file.write_bytes(file.read_bytes()[:-size])
    index = FleetIndex(tmp_path, width=WIDTH)
    for read in (lambda: index.query(draw(1)), lambda: index.ids, lambda: index.times):
        with pytest.raises(ValueError, match=rf"^{tmp_path}: expected an index of LanceDB, found a broken one"):
            read()


def test_places_whose_rows_are_no_rows_are_refused(tmp_path):
    index = filled(tmp_path, 5)
    index.table.update(where="row = 4", values={"row": 2})
    for read in (lambda: index.query(draw(1), 5), lambda: index.ids):
        with pytest.raises(ValueError, match=rf"^{tmp_path}: expected an index of LanceDB, found a broken one"):
            read()


@pytest.mark.parametrize(
    ("about", "message"),
    [
        (b"nothing", "expected JSON, found invalid JSON"),
        (b"[]", f"expected format '{FORMAT}'"),
        (json.dumps({"format": FORMAT}).encode(), ".*found no `width`"),
        (json.dumps({"format": FORMAT, "width": "8", "weights_hash": ""}).encode(), "`width`: expected a value"),
        (json.dumps({"format": FORMAT, "width": 8, "weights_hash": None}).encode(), "`weights_hash`: expected a value"),
        (json.dumps({"format": FORMAT, "width": 8, "weights_hash": ""}).encode(), "expected a column row of int64"),
    ],
)
def test_a_table_of_another_program_is_refused(tmp_path, about, message):
    import pyarrow

    rows = pyarrow.table({"id": ["a"]}).replace_schema_metadata({"about": about})
    FleetIndex(tmp_path, width=WIDTH)._connection.create_table(TABLE, rows)
    with pytest.raises(ValueError, match=rf"{tmp_path}.*: {message}"):
        FleetIndex(tmp_path, width=WIDTH)


def test_without_the_extra_it_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lancedb", None)
    with pytest.raises(ImportError, match=r"needs the extra `fleet`"):
        FleetIndex(tmp_path)


@settings(deadline=None)
@given(flags=st.lists(st.booleans(), max_size=30))
def test_runs_are_all_set_flags(flags):
    rows = [row for first, last in _runs(np.array(flags, bool)) for row in range(first, last + 1)]
    assert rows == np.flatnonzero(np.array(flags, bool)).tolist()
