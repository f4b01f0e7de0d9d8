"""The tables of the paper are complete, consistent, and have the printed means."""

import re

import numpy as np
import pytest

from sglpr_jax.evaluation.published import TABLE_1, TABLES

ROUNDING = 0.0005 + 1e-9
ODD_MEANS = {(1, "SC_LPR"): 0.8533, (2, "SC_LPR"): 0.8533}
"""Rows whose printed mean differs from the mean of their scores, see `published`."""
NAMES = {"SC": "Scan Context", "LI": "LiDAR Iris", "PNV": "PointNetVLAD", "OT": "OverlapTransformer"}


@pytest.mark.parametrize("table", TABLES, ids=lambda table: f"table {table.number}")
def test_every_row_is_complete_and_has_the_printed_mean(table):
    for row in table.rows:
        assert len(row.scores) == len(table.columns) and 0 <= min(row.scores) <= max(row.scores) <= 1
        expected = ODD_MEANS.get((table.number, row.method), row.mean)
        assert abs(np.mean(row.scores) - expected) <= 2 * ROUNDING, row  # the scores are rounded, too
    assert len({row.method for row in table.rows}) == len(table.rows)


def test_the_numbers_are_in_the_text_of_the_paper(shared):
    """The numbers of each row are in one line of the text, in this order, and the text has no other such line."""
    text = (shared / "paper/sg-lpr.md").read_text()
    printed = []
    for line in text[text.index("\nTable 1.") :].splitlines():
        cells = re.sub(r"</?u>", "", line).split("\t")
        numbers = [float(cell) for cell in cells if re.fullmatch(r"[01]\.\d{3}", cell)]
        if len(numbers) >= 7:
            printed.append(tuple(numbers[:7]))
    assert printed == [(*row.scores, row.mean) for table in TABLES for row in table.rows]
    for row in TABLE_1.rows:
        short = next((s for s, name in NAMES.items() if name == row.method), row.method)
        scores = r"\t".join(f"{score:.3f}" for score in row.scores)
        assert re.search(rf"\t{short} ?[\[(].*?\t{scores}", re.sub(r"</?u>", "", text)), row
