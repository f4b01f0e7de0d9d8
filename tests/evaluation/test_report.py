import json

import numpy as np
import pytest
from rich.console import Console

from sglpr_jax.evaluation import report


@pytest.fixture
def found(make_file, two_laps):
    rng = np.random.default_rng(0)
    return report.evaluate(make_file(two_laps, two_laps / 200 + rng.normal(scale=0.02, size=(800, 3))))


@pytest.fixture
def nothing_to_find(make_file, straight):
    return report.evaluate(make_file(straight * 10, np.ones((800, 4))))


def render(table):
    console = Console(width=200)
    with console.capture() as capture:
        console.print(table)
    return capture.get()


def test_every_protocol_is_reported_with_what_it_rests_on(found):
    assert [result.name for result in found] == ["top-1 F1max", "pairs F1max", "Recall@1"]
    text = render(report.table(found, title="Sequence 06"))
    for word in ("Sequence 06", "top-1 F1max", "pairs F1max", "Recall@1", "made up", "2-D", "3-D"):
        assert word in text
    for count in ("510 queries", "400 revisits", "400 positive pairs", "40000 negative pairs", "320 queries"):
        assert count in text
    for rule in ("last 290 frames excluded", "100 negatives per positive", "map is the first 60% of the frames"):
        assert rule in text
    for result in found:
        assert 0 < result.score <= 1
        assert f"{result.score:.3f}" in text


def test_a_sequence_without_revisits_says_so(nothing_to_find):
    text = render(report.table(nothing_to_find))
    assert text.count("no revisit") == 3
    assert "nan" not in text


def test_methods_stand_side_by_side(found, nothing_to_find):
    text = render(report.comparison({"ours": found, "other": nothing_to_find}))
    rows = {line.split("│")[1].strip(): line for line in text.splitlines() if "│" in line}
    assert f"{found[0].score:.3f}" in rows["ours"]
    assert rows["other"].count("no revisit") == 3


def test_json_says_the_same(found, nothing_to_find):
    plain = json.loads(json.dumps(report.to_json(found), allow_nan=False))
    top1, pairs, recall = plain
    assert top1["score"] == found[0].score
    assert top1["counts"] == {"queries": 510, "revisits": 400}
    assert (top1["dimensions"], pairs["dimensions"], recall["dimensions"]) == (3, 2, 3)
    best = pairs["at_f1max"]
    harmonic = 2 * best["precision"] * best["recall"] / (best["precision"] + best["recall"])
    assert harmonic == pytest.approx(pairs["score"])
    assert best["distance"] > 0
    assert recall["at_f1max"] is None
    assert [entry["score"] for entry in report.to_json(nothing_to_find)] == [None, None, None]
