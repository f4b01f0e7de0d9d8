"""The table, the numbers and the plot of a stress test, from results made up for it."""

import io
import json

import numpy as np
import pytest
from rich.console import Console

from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.protocols.protocol import Result
from sglpr_jax.evaluation.stress_table import StressRow, changes_by_kind, score_changes, stress_json, stress_table


def results(*scores):
    return [
        Result(name, "rule", 3, "poses", "its poses", score=score)
        for name, score in zip(("F1", "recall"), scores, strict=True)
    ]


@pytest.fixture
def rows():
    return [
        StressRow("clean", "clean", "clean", {"good": results(0.9, 0.8), "poor": results(0.5, np.nan)}),
        StressRow("beams-32", "beams", "32", {"good": results(0.9004, 0.75), "poor": results(0.4, np.nan)}),
        StressRow("beams-16", "beams", "16", {"good": results(0.8996, 0.7), "poor": results(0.6, np.nan)}),
        StressRow("rotation", "rotation", "rotation", {"good": results(0.9, 0.8), "poor": results(0.1, np.nan)}),
    ]


def test_changes_are_those_against_the_clean_sequence(rows):
    changes = score_changes(rows[2], rows[0])
    np.testing.assert_allclose(changes["good"], [-0.0004, -0.1])
    np.testing.assert_allclose(changes["poor"], [0.1, np.nan])


def test_the_table_has_scores_and_changes(rows):
    console = Console(file=io.StringIO(), width=140)
    console.print(stress_table(rows, title="sequence 08"))
    said = console.file.getvalue()
    lines = [[cell.strip() for cell in line.split("│")[1:-1]] for line in said.splitlines() if "│" in line]
    assert lines == [
        ["clean", "0.900", "0.800", "0.500", "no revisit"],
        ["beams-32", "0.900 +0.000", "0.750 -0.050", "0.400 -0.100", "no revisit"],
        ["beams-16", "0.900 +0.000", "0.700 -0.100", "0.600 +0.100", "no revisit"],
        ["rotation", "0.900 +0.000", "0.800 +0.000", "0.100 -0.400", "no revisit"],
    ]
    assert said.count("good") == said.count("poor") == said.count("F1") == said.count("recall") == 2


def test_json_has_every_result_with_its_change(rows):
    found = json.loads(json.dumps(stress_json(rows), allow_nan=False))
    assert [row["corruption"] for row in found] == [row.name for row in rows]
    f1, recall = found[1]["methods"]["poor"]
    assert (f1["protocol"], f1["score"]) == ("F1", 0.4) and f1["change"] == pytest.approx(-0.1)
    assert recall["score"] is None and recall["change"] is None
    assert found[0]["methods"]["good"][0]["change"] == 0


def test_the_plot_has_a_panel_for_each_protocol_and_kind_and_a_line_for_each_method(rows, tmp_path):
    figure = figures.stress(changes_by_kind(rows), title="sequence 08")
    assert [axes.get_title() for axes in figure.axes] == ["beams", "rotation", "", ""]
    assert [axes.get_ylabel() for axes in figure.axes] == ["F1: change", "", "recall: change", ""]
    beams = figure.axes[0]
    assert [label.get_text() for label in beams.get_xticklabels()] == ["clean", "32", "16"]
    good, poor = beams.get_lines()[:2]
    np.testing.assert_allclose(good.get_ydata(), [0, 0.0004, -0.0004])
    np.testing.assert_allclose(poor.get_ydata(), [0, -0.1, 0.1])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["good", "poor"]
    figures.save(figure, tmp_path / "stress.png")
    assert [path.name for path in tmp_path.iterdir()] == ["stress.png"]
