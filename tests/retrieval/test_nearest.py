"""Nearest neighbours are those that numpy finds over all pairs, without the frames that are too recent."""

import numpy as np
import pytest

from sglpr_jax.retrieval import nearest as nearest_module
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import l2
from sglpr_jax.retrieval.nearest import nearest


def file_of(
    descriptors: np.ndarray, *, sequence: str = "00", times: bool = True, distance: str = "l2"
) -> DescriptorFile:
    n = len(descriptors)
    return DescriptorFile(
        sequence=sequence,
        ids=tuple(f"{i:06d}" for i in range(n)),
        positions=None,
        times=np.arange(n) / 2 if times else None,
        descriptors=descriptors.astype(np.float32),
        pose_source=None,
        config={},
        weights_hash="",
        distance=distance,
    )


@pytest.fixture
def descriptors() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(700, 8))


@pytest.mark.parametrize("distance", ["l2", "cosine"])
def test_the_nearest_of_another_session_are_those_of_all_pairs(descriptors, distance):
    today, yesterday = file_of(descriptors[:600], distance=distance), file_of(descriptors[600:], distance=distance)
    found = nearest(today, yesterday, k=3)
    q, d = (file.descriptors.astype(np.float64) for file in (today, yesterday))
    if distance == "cosine":
        q, d = (rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in (q, d))
    every = np.linalg.norm(q[:, None] - d[None], axis=2)
    np.testing.assert_array_equal(found.rows, np.argsort(every, axis=1)[:, :3])
    expected = np.sort(every, axis=1)[:, :3]
    np.testing.assert_allclose(found.distances, expected if distance == "l2" else expected**2 / 2, rtol=1e-4, atol=1e-6)
    assert len(found) == 600 and found.ids(0) == tuple(yesterday.ids[row] for row in found.rows[0])


@pytest.mark.parametrize(("frames", "seconds"), [(0, 0.0), (50, 0.0), (0, 40.0), (10, 2.0)])
def test_recent_frames_of_the_own_recording_are_no_answers(descriptors, frames, seconds):
    own = file_of(descriptors)
    found = nearest(own, exclude_frames=frames, exclude_s=seconds)
    for query in range(len(own)):
        last = query - frames
        while last > 0 and own.times[query] - own.times[last - 1] < seconds:
            last -= 1
        if last <= 0:
            assert found.rows[query, 0] == -1 and np.isinf(found.distances[query, 0]) and found.ids(query) == ()
        else:
            apart = np.linalg.norm(own.descriptors[:last] - own.descriptors[query], axis=1)
            assert found.rows[query, 0] == apart.argmin()


def test_fewer_than_k_are_filled_and_ties_come_in_order():
    found = nearest(file_of(np.zeros((3, 2))), k=4, exclude_frames=0)
    np.testing.assert_array_equal(found.rows, [[-1] * 4, [0, -1, -1, -1], [0, 1, -1, -1]])


def test_many_places_are_compared_with_fewer_queries_at_a_time(descriptors, monkeypatch):
    whole = nearest(file_of(descriptors), k=3)
    monkeypatch.setattr(nearest_module, "PAIRS", 5 * len(descriptors))
    asked = []
    monkeypatch.setattr(nearest_module, "distance_function", lambda name: lambda q, d: asked.append(len(q)) or l2(q, d))
    few = nearest(file_of(descriptors), k=3)
    assert max(asked) == 5 and np.array_equal(few.rows, whole.rows)


def test_more_answers_than_fit_into_memory_are_refused(descriptors):
    with pytest.raises(ValueError, match="expected k up to 1048576, found 1000000000"):
        nearest(file_of(descriptors), k=10**9)
    with pytest.raises(ValueError, match="expected at most 64 queries at a time for k = 1048576, found 700"):
        nearest(file_of(descriptors), k=2**20)


def test_a_result_prints_itself():
    text = str(nearest(file_of(np.eye(4)), file_of(np.eye(4)[::-1], sequence="05")))
    assert text.splitlines()[0] == "4 of 4 queries of 00 in 05 have a match; the nearest ones:"
    assert text.splitlines()[1] == "000000 -> 000003  0.0000"


def test_what_cannot_be_compared_is_refused(descriptors):
    own = file_of(descriptors)
    with pytest.raises(ValueError, match="descriptors of 05 to be made as those of 00, with numbers 8, found 4"):
        nearest(own, file_of(descriptors[:, :4], sequence="05"))
    with pytest.raises(ValueError, match="with distance l2, found cosine"):
        nearest(own, file_of(descriptors, distance="cosine"))
    with pytest.raises(ValueError, match="expected times"):
        nearest(file_of(descriptors, times=False), exclude_s=30.0)
    with pytest.raises(ValueError, match="k of 1 or more, found 0"):
        nearest(own, k=0)
