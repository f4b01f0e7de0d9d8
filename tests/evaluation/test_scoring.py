"""One call scores a descriptor file, a path or arrays, and its result prints itself."""

import dataclasses
import json
from typing import get_args

import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.evaluation.protocols import PROTOCOLS, protocols_taking
from sglpr_jax.evaluation.protocols.source import Kind, ScoredPairs, TopK
from sglpr_jax.evaluation.scoring import evaluate, score
from sglpr_jax.evaluation.sessions import evaluate_session_files


@pytest.fixture
def file(make_file, two_laps):
    noise = np.random.default_rng(0).normal(scale=0.05, size=(800, 3))
    return make_file(two_laps, two_laps / 200 + noise, times=np.arange(800) * 0.5)


def test_a_file_a_path_and_arrays_score_alike(file, tmp_path):
    file.save(tmp_path / "town.npz")
    np.save(tmp_path / "town.npy", file.descriptors)
    where = {"positions": file.positions, "times": file.times}
    whole = evaluate(file)
    assert [result.score for result in whole.results] == [result.score for result in score(file)]
    for same in (
        evaluate(tmp_path / "town.npz"),
        evaluate(str(tmp_path / "town.npy"), **where),
        evaluate(file.descriptors, **where),
    ):
        assert [result.score for result in same.results] == [result.score for result in whole.results]
        assert [result.name for result in same.results] == ["top-1 F1max", "pairs F1max", "Recall@1"]


def scores(*args, **options):
    return [result.score for result in evaluate(*args, **options).results]


def test_arrays_of_jax_and_lists_are_taken(file):
    where = {"positions": file.positions, "times": file.times}
    assert scores(jnp.asarray(file.descriptors), **where) == scores(file)
    as_lists = {name: values.tolist() for name, values in where.items()}
    assert scores(file.descriptors.tolist(), **as_lists) == scores(file)
    with pytest.raises(ValueError, match=r"descriptors \(n, d\), found an array of shape \(3,\)"):
        evaluate(np.zeros(3), **where)


@pytest.mark.slow
def test_options_stand_in_for_what_a_file_says_itself(file, tmp_path):
    bare = dataclasses.replace(file, positions=None, times=None, pose_source=None)
    assert scores(bare, positions=file.positions, times=file.times) == scores(file)
    other = dataclasses.replace(file, times=file.times * 1000, distance="cosine")
    assert scores(file, times=other.times, distance="cosine") == scores(other) != scores(file)
    moved = evaluate(file, positions=file.positions[::-1] * 9)
    np.testing.assert_array_equal(moved.positions, file.positions[::-1] * 9)
    assert {result.pose_source for result in moved.results} == {"positions given as an array"}
    file.save(tmp_path / "town.npz")
    by_path = evaluate(tmp_path / "town.npz", positions=file.positions[::-1] * 9)
    assert [result.rule for result in by_path.results] == [result.rule for result in moved.results]
    assert "last 30 s excluded" in by_path.results[0].rule
    assert scores(tmp_path / "town.npz", times=other.times) == scores(dataclasses.replace(file, times=other.times))


def test_options_that_cannot_apply_are_refused(file, tmp_path):
    (tmp_path / "pairs.txt").write_text("0 1 0.5 1\n0 2 0.1 0\n")
    pairs = ScoredPairs(np.array([[0, 1], [0, 2]]), np.array([0.5, 0.1]), np.array([True, False]))
    answers = TopK("town", file.positions, None, None, np.array([700]), np.array([[300]]))
    for source, options, message in (
        (pairs, {"times": file.times}, "^expected no times beside scored pairs"),
        (tmp_path / "pairs.txt", {"times": file.times}, "pairs.txt: expected no times beside scored pairs"),
        (answers, {"distance": "l2"}, "expected no distance beside up to 1 retrieved frames"),
        (file, {"distance": "cosin"}, "did you mean cosine"),
        (file, {"positions": file.positions[:9]}, r"found float64 \(9, 3\)"),
    ):
        with pytest.raises(ValueError, match=message):
            evaluate(source, **options)


def test_the_result_prints_itself_and_becomes_json(file, tmp_path):
    file.save(tmp_path / "town.npz")
    found = evaluate(tmp_path / "town.npz", ["top1-f1max"])
    for words in ("sequence town, 800 scans", "top-1 F1max", f"{found.results[0].score:.3f}", "3 m / 20 m"):
        assert words in str(found)
    plain = json.loads(json.dumps(found.to_json()))
    assert plain["file"].endswith("town.npz") and plain["distance"] == "l2"
    assert [result["protocol"] for result in plain["results"]] == ["top-1 F1max"]


def test_what_is_missing_is_said(file, tmp_path):
    with pytest.raises(ValueError, match="expected positions of 800 frames"):
        evaluate(file.descriptors)
    with pytest.raises(ValueError, match="expected protocols for descriptors"):
        evaluate(file, ["listed-pairs-f1max"])
    with pytest.raises(FileNotFoundError, match="expected a descriptor file"):
        evaluate(tmp_path / "none.npz")


def test_every_protocol_says_its_rule_its_source_and_what_it_takes():
    for name, protocol in PROTOCOLS.items():
        assert protocol.name == name and protocol.rule and protocol.source and protocol.takes
        assert {kind for kind in get_args(Kind) if name in protocols_taking(kind)} == set(protocol.takes)
    assert [name for name, protocol in PROTOCOLS.items() if protocol.headline] == [
        "top1-f1max",
        "pairs-f1max",
        "bevplace-recall-at-1",
    ]


def test_sessions_of_any_name_are_scored_and_print_themselves(make_file, two_laps, tmp_path):
    for name in ("monday", "tuesday"):
        make_file(two_laps, two_laps / 200, sequence=name).save(tmp_path / f"{name}.npz")
    found = evaluate_session_files(tmp_path / "monday.npz", [tmp_path / "tuesday.npz"])
    assert "published" not in found.to_json() and found.to_json()["database_session"] == "monday"
    for words in ("database monday", "tuesday", "bevplace-nclt-recall", "1.000"):
        assert words in str(found)
