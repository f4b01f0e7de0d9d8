"""Evaluation across sessions: scores and mean of the query sessions, published rows, and invalid files."""

import dataclasses

import numpy as np
import pytest

from sglpr_jax.evaluation.protocols.recall import BEVPLACE_NCLT_RECALL, POINTNETVLAD_RECALL
from sglpr_jax.evaluation.published import TABLE_3, table_3_rows
from sglpr_jax.evaluation.sessions import evaluate_sessions

MAP, NCLT = "2012-01-15", TABLE_3.columns


@pytest.fixture
def session(make_file):
    """Return a function that makes a session on one street, a frame every 10 m, with noisy positions as descriptors."""

    def make(name: str, *, noise_m: float = 6.0, offset_m: float = 0.0):
        rng = np.random.default_rng(len(name) + int(name[5:7]))
        places = np.stack([10.0 * np.arange(50) + rng.normal(0, 1, 50) + offset_m, np.zeros(50), np.zeros(50)], axis=1)
        return make_file(places, (places + rng.normal(0, noise_m, (50, 3))) / 100, sequence=name)

    return make


@pytest.fixture
def evaluate(tmp_path):
    """Return a function that writes sessions to files and evaluates them."""

    def call(database, queries, names=(), **options):
        paths = [tmp_path / f"{number}.npz" for number in range(1 + len(queries))]
        for path, file in zip(paths, (database, *queries), strict=True):
            file.save(path)
        return evaluate_sessions(paths[0], paths[1:], names, **options)

    return call


def test_columns_are_the_scores_of_the_sessions_and_their_mean(session, evaluate):
    database, queries = session(MAP), [session(NCLT[0]), session(NCLT[1])]
    found = evaluate(database, queries)
    assert len(evaluate(database, queries, ["pointnetvlad-recall"]).table().rows) == 1
    nclt = [BEVPLACE_NCLT_RECALL(database, file).score for file in queries]
    runs = [POINTNETVLAD_RECALL(database, file).score for file in queries]
    assert 0 < min(nclt) < 1 and found.table().header == ("", NCLT[0], NCLT[1], "mean")
    assert found.table().rows == [
        ("bevplace-nclt-recall", *(f"{score:.3f}" for score in (*nclt, np.mean(nclt)))),
        ("pointnetvlad-recall", *(f"{score:.3f}" for score in (*runs, np.mean(runs)))),
    ]


def test_sessions_of_one_name_are_named_by_their_files(session, evaluate):
    other = dataclasses.replace(session(NCLT[0]), sequence=MAP)
    (name,) = evaluate(session(MAP), [other]).methods
    assert name.endswith("1") and name != MAP


def test_a_session_without_revisits_is_not_in_the_mean(session, evaluate):
    near, beside = session(NCLT[0]), session(NCLT[1])
    beside = dataclasses.replace(beside, positions=np.add(beside.positions, [0, 12, 0]))
    (row,) = evaluate(session(MAP), [near, beside], ["bevplace-nclt-recall"]).table().rows
    assert row[2] == "no revisit" and row[1] == row[3] != row[2]
    (alone,) = evaluate(session(MAP), [beside], ["bevplace-nclt-recall"]).table().rows
    assert alone[1:] == ("no revisit", "no revisit")


def test_published_rows_have_the_columns_of_the_sessions(session, evaluate):
    queries = [session(name) for name in NCLT]
    whole = evaluate(session(MAP), queries, ["bevplace-nclt-recall"], published=True)
    assert [row[0] for row in whole.published] == [f"published: {row.method}" for row in TABLE_3.rows]
    assert whole.published[-1][1:] == ("0.947", "0.936", "0.931", "0.916", "0.914", "0.913", "0.926")
    part = table_3_rows(MAP, [NCLT[5], "2013-04-05", NCLT[0]])
    assert part[-1] == ("published: SG-LPR", "0.913", "", "0.947", "0.930")


def test_sessions_that_do_not_overlap_or_occur_twice_are_refused(session, evaluate):
    database = session(MAP)
    with pytest.raises(ValueError, match=r"2012-02-04 in the world frame of the database .* no place is in both"):
        evaluate(database, [session(NCLT[0], offset_m=2000)])
    with pytest.raises(ValueError, match=f"expected different sessions, found database {MAP}, queries {MAP}"):
        evaluate(database, [database])
    with pytest.raises(ValueError, match="expected different sessions"):
        evaluate(database, [session(NCLT[0]), session(NCLT[0])])
    evaluate(database, [session(NCLT[0], offset_m=510)])  # the end of one street is the start of the next
