"""From two simulated days to the table of sessions, by the commands a user would type."""

import dataclasses
import json
from typing import NamedTuple

import numpy as np
import pytest

from sglpr_jax import DescriptorFile

from .conftest import Ended, assert_one_line_error, run_command

MAP, DAYS = "2012-01-15", ("2012-02-04", "2012-03-17")
SCANS = 12
THIN = ("--scans", SCANS, "--azimuth-steps", 60, "--rate-hz", 0.2, "--seed", 1)


class Simulated(NamedTuple):
    """The days' folder, and how the command that wrote it ended."""

    root: object
    ended: Ended


@pytest.fixture(scope="module")
def days(tmp_path_factory) -> Simulated:
    root = tmp_path_factory.mktemp("days") / "nclt"
    return Simulated(root, run_command("simulate", "--out", root, "--sessions", MAP, *DAYS, *THIN))


@pytest.fixture(scope="module")
def embedded(days, tmp_path_factory):
    """Scan Context's descriptors of every day."""
    folder = tmp_path_factory.mktemp("descriptors")
    for day in (MAP, *DAYS):
        ended = run_command(
            "embed", "--method", "scan-context", "--data", days.root, "--seq", day, "--out", folder / f"{day}.npz"
        )
        assert ended.status == 0, ended.error
    return folder


def files(folder):
    return [*(folder / f"{day}.npz" for day in DAYS), "--database", folder / f"{MAP}.npz"]


def test_a_table_has_a_column_for_each_session(embedded, command, tmp_path):
    ended = command("evaluate", *files(embedded), "--out", tmp_path / "out")
    assert ended.status == 0, ended.error
    for words in ("bevplace-nclt-recall", "pointnetvlad-recall", *DAYS, "mean", "12 queries"):
        assert words in ended.out
    assert "published" not in ended.out
    report = json.loads((tmp_path / "out" / "results.json").read_text())
    recall = report["results"]["bevplace-nclt-recall"]
    scores = [recall["sessions"][day]["score"] for day in DAYS]
    known = [score for score in scores if score is not None]  # null: no revisit
    assert (
        recall["mean"] == pytest.approx(np.mean(known))
        and report["database_session"] == MAP
        and "published" not in report
    )
    assert f'<td class="number">{recall["mean"]:.3f}</td>' in (tmp_path / "out" / "report.html").read_text()


def test_published_numbers_stand_apart_and_are_of_the_real_dataset(embedded, command, tmp_path):
    ended = command("evaluate", *files(embedded), "--published", "--out", tmp_path / "out")
    assert ended.status == 0, ended.error
    assert ended.out.count("published: ") == 8 and "on real NCLT" in ended.out
    report = json.loads((tmp_path / "out" / "results.json").read_text())
    assert ["published: SG-LPR", "0.947", "0.936", "0.942"] in report["published"]["rows"]
    assert "real NCLT" in report["published"]["about"]
    assert "real NCLT" in (tmp_path / "out" / "report.html").read_text()


def test_published_numbers_of_one_sequence_are_those_of_learned_methods(command, tmp_path):
    place = np.stack([np.arange(60.0), np.zeros(60), np.zeros(60)], axis=1)
    ids = tuple(f"{i:06d}" for i in range(60))
    file = DescriptorFile("08", ids, place, None, place.astype(np.float32), "made up", {}, "")
    file.save(tmp_path / "08.npz")
    ended = command("evaluate", tmp_path / "08.npz", "--published")
    assert ended.status == 0, ended.error
    for words in ("published F1max", "DiSCO", "0.903", "RINet's paper", "SG-LPR", "0.898", "real KITTI"):
        assert words in ended.out
    assert "M2DP" not in ended.out
    report = json.loads((tmp_path / "08" / "results.json").read_text())
    assert ["DiSCO", "0.903", "its own paper"] in report["published"]
    assert "<h2>Published numbers</h2>" in (tmp_path / "08" / "report.html").read_text()

    dataclasses.replace(file, sequence="town").save(tmp_path / "town.npz")
    assert_one_line_error(
        command("evaluate", tmp_path / "town.npz", "--published"), "sequence with published numbers", "00, 02", "town"
    )


def test_wrong_sessions_are_refused(embedded, command, tmp_path):
    database = embedded / f"{MAP}.npz"
    day = DescriptorFile.load(embedded / f"{DAYS[0]}.npz")

    def refused(*arguments):
        return command("evaluate", *arguments, "--out", tmp_path / "out")

    dataclasses.replace(day, positions=day.positions + 1e5).save(tmp_path / "far.npz")
    ended = refused(tmp_path / "far.npz", "--database", database)
    assert_one_line_error(ended, DAYS[0], "the world frame of the database", MAP, "no place is in both")
    dataclasses.replace(day, descriptors=day.descriptors[:, :40]).save(tmp_path / "short.npz")
    assert_one_line_error(
        refused(tmp_path / "short.npz", "--database", database), "short.npz", "numbers 1200", "found 40"
    )
    dataclasses.replace(day, sequence="2012-02-05").save(tmp_path / "other.npz")
    ended = refused(tmp_path / "other.npz", "--database", database, "--published")
    assert_one_line_error(ended, "numbers are published", "2012-02-05")
    np.save(tmp_path / "mine.npy", day.descriptors)
    assert_one_line_error(refused(tmp_path / "mine.npy", "--database", database), "mine.npy", "bin/embed (.npz)")
    assert_one_line_error(refused(database, "--database", database), "different sessions", MAP)
    ended = refused(embedded / f"{DAYS[0]}.npz", "--database", database, "--seq", "00")
    assert_one_line_error(ended, "only descriptor files with --database", "--seq")
    assert_one_line_error(refused(database, embedded / f"{DAYS[0]}.npz"), "--database", "--compare")
    ended = refused(database, "--protocol", "bevplace-nclt-recall")
    assert_one_line_error(ended, "expected --database", "bevplace-nclt-recall")
    assert not (tmp_path / "out").exists()


def test_wrong_days_are_refused_before_anything_is_written(command, tmp_path):
    out = ("--out", tmp_path / "town")
    assert_one_line_error(command("simulate", *out, "--sessions", "2012-1-32"), "dates such as", "'2012-1-32'")
    ended = command("simulate", *out, "--sessions", MAP, "--seq", "00", "05")
    assert_one_line_error(ended, "at most one route")
    assert_one_line_error(command("simulate", *out, "--sessions", MAP, "--images"), "no images, found", "images True")
    assert not (tmp_path / "town").exists()
