import json

import numpy as np
import pytest
from rich.console import Console

from sglpr_jax.evaluation import report
from sglpr_jax.evaluation.protocols import protocols_taking, score


@pytest.fixture(scope="module")
def found(noisy_laps):
    return score(noisy_laps)


@pytest.fixture(scope="module")
def nothing_to_find(make_file, straight):
    return score(make_file(straight * 10, np.ones((800, 4))))


def render(table, width=200):
    console = Console(width=width)
    with console.capture() as capture:
        console.print(table)
    return capture.get()


def test_the_comparison_shows_whole_names_of_many_protocols(found, nothing_to_find, noisy_laps):
    text = render(report.comparison({"ours": found, "other": nothing_to_find}))
    rows = {line.split("│")[1].strip(): line for line in text.splitlines() if "│" in line}
    assert f"{found[0].score:.3f}" in rows["ours"]
    assert rows["other"].count("no revisit") == 3 and "nan" not in text
    results = score(noisy_laps, list(protocols_taking("descriptors")))
    lines = render(report.comparison({"ours": results, "other": results}), width=80).splitlines()
    for result in results:
        assert any(result.name in line and report.format_score(result.score) in line for line in lines)


def test_json_has_the_numbers_of_the_results(found, nothing_to_find):
    top1, pairs, recall = json.loads(json.dumps(report.to_json(found), allow_nan=False))
    assert top1["score"] == found[0].score and top1["interval"] == list(found[0].interval)
    assert top1["counts"] == {"queries": 510, "revisits": 400}
    assert (top1["dimensions"], pairs["dimensions"], recall["dimensions"]) == (3, 2, 3)
    assert (top1["published_on"], pairs["published_on"]) == ("SemanticKITTI's poses", "KITTI's own poses")
    assert pairs["average_precision"] == found[1].curve.average_precision
    assert recall["recall_at"] == {"1": recall["score"]}
    best = pairs["at_f1max"]
    harmonic = 2 * best["precision"] * best["recall"] / (best["precision"] + best["recall"])
    assert harmonic == pytest.approx(pairs["score"]) and best["distance"] > 0
    assert recall["at_f1max"] is None and recall["at_precision"] == {}
    rows = report.threshold_table(found).rows
    assert [row[1] for row in rows] == 2 * ["highest F1", "precision 0.99", "precision 1"]
    assert float(rows[3][2]) == pytest.approx(best["distance"], abs=5e-4)
    assert [entry["score"] for entry in report.to_json(nothing_to_find)] == [None, None, None]
