"""From two simulated days to the table of sessions, by the commands a user would type."""

import dataclasses
import json

import numpy as np
import pytest

from sglpr_jax import DescriptorFile
from sglpr_jax.sim.dataset import simulate

from .conftest import SENSOR, assert_one_line_error, run_command

MAP, DAYS = "2012-01-15", ("2012-02-04", "2012-03-17")
SCANS = 12


@pytest.fixture(scope="module")
def embedded(tmp_path_factory):
    """Scan Context's descriptors of every day."""
    folder = tmp_path_factory.mktemp("descriptors")
    simulate(folder / "nclt", sessions=(MAP, *DAYS), scans=SCANS, sensor=SENSOR, seed=1)
    for day in (MAP, *DAYS):
        options = ("--method", "scan-context", "--data", folder / "nclt", "--seq", day)
        assert run_command("embed", *options, "--out", folder / f"{day}.npz").status == 0
    return folder


def files(folder):
    return [*(folder / f"{day}.npz" for day in DAYS), "--database", folder / f"{MAP}.npz"]


def test_a_table_has_a_column_for_each_session_and_the_published_numbers(embedded, command, tmp_path):
    ended = command("evaluate", *files(embedded), "--published", "--out", tmp_path / "out")
    assert ended.status == 0, ended.error
    for words in ("bevplace-nclt-recall", "pointnetvlad-recall", *DAYS, "mean", "12 queries", "on real NCLT"):
        assert words in ended.out
    report = json.loads((tmp_path / "out" / "results.json").read_text())
    recall = report["results"]["bevplace-nclt-recall"]
    scores = [recall["sessions"][day]["score"] for day in DAYS]
    known = [score for score in scores if score is not None]  # null: no revisit
    assert recall["mean"] == pytest.approx(np.mean(known)) and report["database_session"] == MAP
    assert ["published: SG-LPR", "0.947", "0.936", "0.942"] in report["published"]["rows"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "real NCLT" in page and f'<td class="number">{recall["mean"]:.3f}</td>' in page


def test_wrong_sessions_are_refused(embedded, command, tmp_path):
    database = embedded / f"{MAP}.npz"
    day = DescriptorFile.load(embedded / f"{DAYS[0]}.npz")

    def refused(*arguments):
        return command("evaluate", *arguments, "--out", tmp_path / "out")

    dataclasses.replace(day, descriptors=day.descriptors[:, :40]).save(tmp_path / "short.npz")
    assert_one_line_error(
        refused(tmp_path / "short.npz", "--database", database), "short.npz", "numbers 1200", "found 40"
    )
    dataclasses.replace(day, sequence="2012-02-05").save(tmp_path / "other.npz")
    ended = refused(tmp_path / "other.npz", "--database", database, "--published")
    assert_one_line_error(ended, "numbers are published", "2012-02-05")
    np.save(tmp_path / "mine.npy", day.descriptors)
    assert_one_line_error(refused(tmp_path / "mine.npy", "--database", database), "mine.npy", "bin/embed (.npz)")
    ended = refused(embedded / f"{DAYS[0]}.npz", "--database", database, "--seq", "00")
    assert_one_line_error(ended, "only descriptor files with --database", "--seq")
    assert not (tmp_path / "out").exists()
