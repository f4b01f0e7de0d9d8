"""The index answers as numpy does over all pairs, refuses what does not fit, and comes back from its file."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax import Index
from sglpr_jax.data.formats.tensors import hash_of, tensors_as_bytes
from sglpr_jax.retrieval.index import FORMAT

from .places import WIDTH, add_places, draw, file_of


def index_of(n: int, **about) -> Index:
    index = Index.empty(WIDTH, **about)
    add_places(index, n)
    return index


@settings(deadline=None, max_examples=30)
@given(n=st.integers(1, 700), parts=st.integers(1, 5), k=st.integers(1, 20), excluded=st.floats(0, 1))
def test_the_nearest_are_those_of_all_pairs_however_they_were_added(n, parts, k, excluded):
    rows, queries = draw(n), draw(5, seed=1)
    index = Index.empty(WIDTH)
    for part in np.array_split(rows, parts):
        index.add(part)
    left_out = np.random.default_rng(n).random(n) < excluded
    found = index.query(queries, k, exclude=left_out)
    every = np.linalg.norm(queries[:, None].astype(np.float64) - rows[None], axis=2)
    every[:, left_out] = np.inf
    order = np.argsort(every, axis=1, kind="stable")[:, :k]
    there = min(k, n - left_out.sum())
    np.testing.assert_array_equal(found.rows[:, :there], order[:, :there])
    np.testing.assert_allclose(found.distances[:, :there], np.take_along_axis(every, order, axis=1)[:, :there])
    assert (found.rows[:, there:] == -1).all() and np.isinf(found.distances[:, there:]).all()
    assert index.ids == [f"{row:06d}" for row in range(n)]


def test_it_comes_back_from_its_file_and_goes_on_growing(tmp_path):
    index = index_of(300, weights_hash="abc")
    index.save(tmp_path / "places.safetensors")
    again = Index.load(tmp_path / "places.safetensors", weights_hash="abc")
    assert again.ids == index.ids and (again.width, again.distance) == (WIDTH, "l2")
    for name in ("descriptors", "times", "positions"):
        np.testing.assert_array_equal(getattr(again, name), getattr(index, name))
    again.add(draw(1, seed=9)[0], ids="new", times=151.0, positions=np.zeros(3))
    assert again.query(draw(1, seed=9)[0]).rows.tolist() == [300] and again.ids[-1] == "new" and len(index) == 300


def test_equal_places_come_in_their_order_and_one_descriptor_gives_one_answer():
    index = Index.empty(WIDTH)
    index.add(np.repeat(draw(2), 20, axis=0))
    found = index.query(draw(2)[1], 3)
    assert found.rows.tolist() == [20, 21, 22] and found.distances.tolist() == [0, 0, 0]


def test_recent_places_are_left_out_by_time_or_by_number():
    index = index_of(100)  # one each half second
    assert np.flatnonzero(index.recent(50.0)).tolist() == list(range(41, 100))
    assert np.flatnonzero(index.recent(frames=3)).tolist() == [97, 98, 99]
    assert index.query(draw(100)[99], 1, exclude=index.recent(50.0)).rows[0] <= 40


def test_descriptors_of_another_model_scale_or_distance_are_refused(tmp_path):
    index = index_of(5, weights_hash="abc")
    index.save(tmp_path / "places.safetensors")
    for refused in (
        lambda: index.add(draw(1), weights_hash="xyz"),
        lambda: index.query(draw(1), weights_hash="xyz"),
        lambda: Index.load(tmp_path / "places.safetensors", weights_hash="xyz"),
    ):
        with pytest.raises(ValueError, match="expected descriptors with weights abc, found xyz"):
            refused()
    with pytest.raises(ValueError, match="expected descriptors with scale 1, found 2: they are not comparable"):
        index.check(scale=2)


def test_a_descriptor_file_becomes_an_index_of_its_scale(tmp_path):
    file = dataclasses.replace(file_of(7), config={"scale": 4})
    Index.of(file).save(tmp_path / "rooms.safetensors")
    index = Index.load(tmp_path / "rooms.safetensors")
    assert index.ids == list(file.ids) and index.weights_hash == "abc" and index.positions is None and index.scale == 4
    np.testing.assert_array_equal(index.times, file.times)


def test_what_does_not_fit_is_refused_and_changes_nothing():
    index = index_of(5)
    for wrong, message in (
        ({"times": np.zeros(1)}, "expected places with descriptors, times, positions"),
        ({"times": np.zeros(2), "positions": np.zeros((1, 3))}, "times of shape"),
        ({"times": np.array([np.nan]), "positions": np.zeros((1, 3))}, "finite times"),
        ({"ids": ("a", "b")}, "expected 1 ids"),
    ):
        with pytest.raises(ValueError, match=message):
            index.add(draw(1), **wrong)
    for query, options, message in (
        (np.full(WIDTH, np.nan, np.float32), {}, "finite descriptors"),
        (np.zeros((1, 9), np.float32), {}, r"shape \(1, 8\), found \(1, 9\)"),
        (draw(1), {"k": 0}, "expected k from 1 up to 1048576, found 0"),
        (draw(1), {"k": 10**9}, "expected k from 1 up to 1048576, found 1000000000"),
        (draw(65), {"k": 2**20}, "expected at most 64 queries at a time for k = 1048576, found 65"),
        (draw(1), {"exclude": np.zeros(6, bool)}, "one flag for each of 5"),
    ):
        with pytest.raises(ValueError, match=message):
            index.query(query, **options)
    assert len(index) == 5


def test_a_flipped_byte_anywhere_is_noticed(tmp_path):
    path = tmp_path / "places.safetensors"
    index_of(20).save(path)
    whole = path.read_bytes()
    for place in np.linspace(0, len(whole) - 1, 60).astype(int):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with pytest.raises(ValueError, match=r"places\.safetensors: expected an index"):
            Index.load(path)
    path.write_bytes(whole[:-10])
    with pytest.raises(ValueError, match="an invalid safetensors file"):
        Index.load(path)
    with pytest.raises(FileNotFoundError, match="expected an index, found none"):
        Index.load(tmp_path / "elsewhere")


def with_checksum(path, arrays=None, **about):
    """Write a file whose checksum is right, whatever its content."""
    arrays = {"descriptors": draw(3)} | (arrays or {})
    valid = {"format": FORMAT, "width": WIDTH, "weights_hash": "", "distance": "l2", "ids": ["a", "b", "c"]}
    text = json.dumps(valid | about)
    path.write_bytes(tensors_as_bytes(arrays, {"about": text, "sha256": hash_of(arrays, about=text)}))
    return path


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"format": "other 1"}, f"expected format '{FORMAT}', found 'other 1'"),
        ({"width": 0}, "`width`: expected a number from 1"),
        ({"ids": ["a", "b", 3]}, "expected `ids` as a list of strings"),
        ({"ids": ["a", "b"]}, r"expected descriptors as float32 \(2, 8\), found float32 \(3, 8\)"),
        ({"arrays": {"times": np.array([0, np.inf, 1])}}, "expected finite times"),
    ],
)
def test_a_file_of_another_program_is_refused_though_its_checksum_is_right(tmp_path, content, message):
    assert len(Index.load(with_checksum(tmp_path / "good.safetensors"))) == 3
    with pytest.raises(ValueError, match=rf"i\.safetensors.*: .*{message}"):
        Index.load(with_checksum(tmp_path / "i.safetensors", **content))


def test_lists_are_converted_and_others_are_one_error():
    index = index_of(5)
    assert index.query(draw(5)[1].tolist(), 2, exclude=[False] * 5).rows[0] == 1
    with pytest.raises(ValueError, match="expected flags"):
        index.query(draw(1), exclude=[0] * 5)
    with pytest.raises(ValueError, match="expected descriptors of 8 numbers, found others"):
        index.query([[1.0], [1.0, 2.0]])


def test_no_places_begin_no_column():
    index = Index.empty(WIDTH)
    assert index.query(draw(1)[0], 2).rows.tolist() == [-1, -1]
    index.add(np.zeros((0, WIDTH)), times=np.zeros(0), positions=np.zeros((0, 3)))
    index.add(draw(2))
    assert len(index) == 2 and index.times is None and index.positions is None
    with pytest.raises(ValueError, match="times of shape"):
        index.add(np.zeros((0, WIDTH)), times=np.zeros(1))


def test_the_same_query_finds_places_that_were_added_or_removed_since():
    """Its distances to the places before are kept."""
    rng = np.random.default_rng(0)
    index = Index.empty(8)
    index.add(rng.normal(size=(20, 8)))
    query = rng.normal(size=8).astype(np.float32)
    before = index.query(query, 20).rows
    assert (index.query(query, 19, exclude=np.arange(20) == before[0]).rows == before[1:]).all()
    index.add(query)
    assert index.query(query).rows[0] == 20
    index.keep(np.arange(21) != 20)
    assert (index.query(query, 20).rows == before).all()


def test_places_without_times_may_follow_removed_places_with_times(tmp_path):
    index = Index.empty(WIDTH)
    index.add(draw(4), times=np.arange(4.0))
    index.keep(np.zeros(4, bool))
    index.add(draw(2))
    assert index.times is None and index.query(draw(2)[1]).rows[0] == 1
    index.save(tmp_path / "places.safetensors")
    assert len(Index.load(tmp_path / "places.safetensors")) == 2
