"""The index of a fleet: answers, conditions, several writers, and tables of other weights."""

import numpy as np
import pyarrow
import pytest
from lancedb.index import BTree

from sglpr_jax import FleetIndex, Index
from sglpr_jax.retrieval.fleet_index import TABLE
from sglpr_jax.retrieval.parquet import FORMAT, place_rows

from .places import draw, file_of


@pytest.fixture
def filled(tmp_path) -> FleetIndex:
    """Thirty places of each of two recordings."""
    index = FleetIndex(tmp_path, weights_hash="abc")
    index.add(place_rows(file_of(30), "first", site="north"))
    index.add(place_rows(file_of(30, seed=1), "second", site="south"))
    return index


def test_the_answers_are_those_of_the_exact_index(filled):
    exact = Index.empty(8)
    exact.add(np.concatenate([draw(30), draw(30, seed=1)]))
    queries = np.concatenate([draw(4, seed=2), draw(2)])
    expected = exact.query(queries, 5)
    for found in (filled.query(queries, 5), filled.query(queries, 5, probes=None)):
        assert found["query"].to_pylist() == np.repeat(range(6), 5).tolist()
        rows = [30 * (one == "second") + int(scan.removeprefix("frame")) for one, scan in _names(found)]
        assert rows == expected.rows.ravel().tolist()
        np.testing.assert_allclose(found["distance"], expected.distances.ravel(), atol=1e-3)
    one = filled.query(queries[0], 5)
    assert one["query"].to_pylist() == [0] * 5 and one["place"].to_pylist() == found["place"].to_pylist()[:5]


def _names(found: pyarrow.Table) -> list[tuple[str, str]]:
    return [tuple(place.split("/")) for place in found["place"].to_pylist()]


def test_conditions_hold_before_the_search(filled):
    for where in ("site = 'south'", "recording != 'first'", "site = 'south' AND time >= 0"):
        assert set(filled.query(draw(1), 30, where=where, columns=["recording"])["recording"].to_pylist()) == {"second"}
    assert filled.query(draw(1), 60, where="time BETWEEN 2 AND 3").num_rows == 6
    with pytest.raises(ValueError, match=rf"^{filled.address}: expected a store .* No field named town"):
        filled.query(draw(1), where="town = 'x'")


def test_a_place_is_added_once_and_all_processes_see_it(filled):
    other = FleetIndex(filled.address)
    assert other.add(place_rows(file_of(31), "first", site="north")) == 1
    assert len(filled) == 61 and other.about == {"width": 8, "weights_hash": "abc", "scale": 1}


@pytest.mark.slow
def test_an_approximate_index_finds_nearest_places_and_those_added_later(tmp_path):
    index = FleetIndex(tmp_path)
    index.add(place_rows(file_of(600), "first", site="north"))
    index.table.create_index("recording", config=BTree())  # of an `optimize` that was killed
    index.optimize()
    index.add(place_rows(file_of(30, seed=1), "later", site="south"))
    for _ in range(2):
        assert index.query(draw(600)[5])["place"].to_pylist() == ["first/frame5"]
        assert index.query(draw(30, seed=1)[5])["place"].to_pylist() == ["later/frame5"]
        assert _names(index.query(draw(600)[5], where="site = 'south'"))[0][0] == "later"
        index.optimize()
    assert {(*one.columns, one.num_unindexed_rows) for one in index.table.list_indices()} == {
        (column, 0) for column in ("place", "recording", "time", "site", "descriptor")
    }


def test_an_index_opened_before_the_first_place_of_another_process_finds_it(tmp_path):
    early, counting, others = FleetIndex(tmp_path), FleetIndex(tmp_path), FleetIndex(tmp_path, weights_hash="xyz")
    for call in (lambda: early.query(draw(1)), early.optimize):
        with pytest.raises(ValueError, match=rf"^{tmp_path}: expected an index with places, found none"):
            call()
    FleetIndex(tmp_path).add(place_rows(file_of(3), "first"))
    assert early.query(draw(3)[1])["place"].to_pylist() == ["first/frame1"] and len(counting) == 3
    with pytest.raises(ValueError, match="expected places with weights_hash xyz, found abc"):
        others.query(draw(1))


def test_places_of_other_weights_are_refused(filled):
    message = rf"^{filled.address}: expected places with weights_hash xyz, found abc: they are"
    with pytest.raises(ValueError, match=message):
        FleetIndex(filled.address, weights_hash="xyz")
    with pytest.raises(ValueError, match="expected places with weights_hash abc, found xyz"):
        filled.add(place_rows(file_of(3, weights_hash="xyz"), "third"))
    with pytest.raises(ValueError, match=r"shape \(1, 8\), found \(1, 9\)"):
        filled.query(np.zeros(9, np.float32))
    assert len(filled) == 60


def test_other_tables_and_broken_ones_are_refused(tmp_path, filled):
    other = FleetIndex(tmp_path / "other")
    other._connection.create_table(TABLE, [{"x": 1}])
    with pytest.raises(ValueError, match=f"other: expected format '{FORMAT}', found None"):
        FleetIndex(tmp_path / "other")
    for file in (tmp_path / f"{TABLE}.lance" / "_versions").iterdir():
        file.write_bytes(b"nothing")
    with pytest.raises(ValueError, match=rf"^{tmp_path}: expected a store that can be read and written, found"):
        FleetIndex(tmp_path)


def test_a_table_that_another_process_is_about_to_create_has_no_places_yet(tmp_path):
    (tmp_path / f"{TABLE}.lance" / "_versions").mkdir(parents=True)
    index = FleetIndex(tmp_path, weights_hash="abc")
    assert len(index) == 0
    assert index.add(place_rows(file_of(3), "first")) == 3
