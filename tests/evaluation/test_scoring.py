"""One call scores a descriptor file, a path or arrays, and its result prints itself."""

import json

import numpy as np
import pytest

from sglpr_jax.evaluation.protocols import PROTOCOLS, kind_of, protocols_taking
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


def test_every_protocol_says_its_rule_its_source_and_what_it_takes(file):
    for name, protocol in PROTOCOLS.items():
        assert protocol.name == name and protocol.rule and protocol.source and protocol.takes
        assert protocol.fits(file) == (name in protocols_taking(kind_of(file)))
    assert [name for name, protocol in PROTOCOLS.items() if protocol.headline] == [
        "top1-f1max",
        "pairs-f1max",
        "bevplace-recall-at-1",
    ]
    recalls = protocols_taking("top-k list")
    assert recalls and all(protocol.returns == "recall" for protocol in recalls.values())


def test_sessions_of_any_name_are_scored_and_print_themselves(make_file, two_laps, tmp_path):
    for name in ("monday", "tuesday"):
        make_file(two_laps, two_laps / 200, sequence=name).save(tmp_path / f"{name}.npz")
    found = evaluate_session_files(tmp_path / "monday.npz", [tmp_path / "tuesday.npz"])
    assert "published" not in found.to_json() and found.to_json()["database_session"] == "monday"
    for words in ("database monday", "tuesday", "bevplace-nclt-recall", "1.000"):
        assert words in str(found)
