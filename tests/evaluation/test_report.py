import dataclasses
import json

import numpy as np
import pytest
from rich.console import Console

from sglpr_jax.evaluation import report
from sglpr_jax.evaluation.protocols import protocols_taking
from sglpr_jax.evaluation.scoring import score


@pytest.fixture
def found(make_file, two_laps):
    rng = np.random.default_rng(0)
    return score(make_file(two_laps, two_laps / 200 + rng.normal(scale=0.02, size=(800, 3))))


@pytest.fixture
def nothing_to_find(make_file, straight):
    return score(make_file(straight * 10, np.ones((800, 4))))


def render(table):
    console = Console(width=200)
    with console.capture() as capture:
        console.print(table)
    return capture.get()


def test_every_protocol_is_reported_with_what_it_rests_on(found):
    assert [result.name for result in found] == ["top-1 F1max", "pairs F1max", "Recall@1"]
    text = render(report.results_table(found, title="Sequence 06"))
    for word in ("Sequence 06", "top-1 F1max", "pairs F1max", "Recall@1", "made up", "2-D", "3-D"):
        assert word in text
    for count in ("510 queries", "400 revisits", "400 positive pairs", "40000 negative pairs", "314 queries"):
        assert count in text
    for rule in ("last 290 frames excluded", "100 negatives per positive", "database is the first 60% of the frames"):
        assert rule in text
    for result in found:
        assert 0 < result.score <= 1
        assert f"{result.score:.3f}" in text
        assert f"{result.interval[0]:.3f} to {result.interval[1]:.3f}" in text


def test_a_sequence_without_revisits_says_so(nothing_to_find):
    text = render(report.results_table(nothing_to_find))
    assert text.count("no revisit") == 3
    assert "nan" not in text


def test_an_interval_has_as_many_places_as_the_score(found):
    one = dataclasses.replace(found[0], score=0.0712, interval=(0.05, 0.1234567))
    assert report.results_table([one]).rows[0][2:4] == ("0.071", "0.050 to 0.123")


def test_methods_stand_side_by_side(found, nothing_to_find):
    text = render(report.comparison({"ours": found, "other": nothing_to_find}))
    rows = {line.split("│")[1].strip(): line for line in text.splitlines() if "│" in line}
    assert f"{found[0].score:.3f}" in rows["ours"]
    assert rows["other"].count("no revisit") == 3


def test_many_protocols_stand_below_one_another_with_their_names_whole(make_file, two_laps):
    results = score(make_file(two_laps, two_laps / 200), list(protocols_taking("descriptors")))
    console = Console(width=80)
    with console.capture() as capture:
        console.print(report.comparison({"ours": results, "other": results}))
    lines = capture.get().splitlines()
    for result in results:
        assert any(result.name in line and report.format_score(result) in line for line in lines)


def test_json_says_the_same(found, nothing_to_find):
    plain = json.loads(json.dumps(report.to_json(found), allow_nan=False))
    top1, pairs, recall = plain
    assert top1["score"] == found[0].score
    assert top1["counts"] == {"queries": 510, "revisits": 400}
    assert (top1["dimensions"], pairs["dimensions"], recall["dimensions"]) == (3, 2, 3)
    assert (top1["published_on"], pairs["published_on"]) == ("SemanticKITTI's poses", "KITTI's own poses")
    assert top1["interval"] == list(found[0].interval)
    assert pairs["average_precision"] == found[1].curve.average_precision
    assert recall["recall_at"] == {"1": recall["score"]}
    best = pairs["at_f1max"]
    harmonic = 2 * best["precision"] * best["recall"] / (best["precision"] + best["recall"])
    assert harmonic == pytest.approx(pairs["score"])
    assert best["distance"] > 0
    assert recall["at_f1max"] is None and recall["at_precision"] == {}
    assert pairs["at_precision"].keys() == {"0.99", "1"}
    rows = report.threshold_table(found).rows
    assert [row[:2] for row in rows[:3]] == [
        (found[0].name, "highest F1"),
        (found[0].name, "precision 0.99"),
        (found[0].name, "precision 1"),
    ]
    assert len(rows) == 6 and float(rows[3][2]) == pytest.approx(best["distance"], abs=5e-4)
    assert [entry["score"] for entry in report.to_json(nothing_to_find)] == [None, None, None]
