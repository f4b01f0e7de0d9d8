"""From two simulated days to the table of sessions, by the commands a user would type."""

import dataclasses
import json

import numpy as np
import pytest

from sglpr_jax import DescriptorFile

from .conftest import assert_one_line_error

MAP, DAYS = "2012-01-15", ("2012-02-04", "2012-03-17")
SCANS = 12


@pytest.fixture(scope="module")
def embedded(tmp_path_factory):
    """Descriptors of every day along one line. On the n-th later day, n queries look like the last place."""
    folder, ids = tmp_path_factory.mktemp("descriptors"), tuple(f"{i:06d}" for i in range(SCANS))
    about = ("ground truth", {"method": "made up"}, "")
    for n, day in enumerate((MAP, *DAYS)):
        line = np.arange(SCANS)[:, None] * [30.0, 0.0, 0.0]
        descriptors = np.pad(line, ((0, 0), (0, 1197))).astype(np.float32)
        descriptors[:n] = descriptors[-1]
        DescriptorFile(day, ids, line + n, np.arange(float(SCANS)), descriptors, *about).save(folder / f"{day}.npz")
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
    assert scores == pytest.approx([11 / 12, 10 / 12]) and recall["mean"] == pytest.approx(np.mean(scores))
    assert report["database_session"] == MAP
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
