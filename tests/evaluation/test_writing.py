"""What a folder holds after an evaluation is written to it: that evaluation alone, and what is somebody else's."""

import dataclasses

import pytest

from sglpr_jax.evaluation.page.writing import write_evaluation, write_sessions
from sglpr_jax.evaluation.scoring import Evaluation, score
from sglpr_jax.evaluation.sessions import evaluate_sessions

NAMES = ["top1-f1max", "pairs-10-f1max"]


@pytest.fixture
def file(make_file, two_laps):
    return make_file(two_laps, two_laps / 200, sequence="monday")


@pytest.fixture
def one(file):
    """One method; its plots are precision-recall.png and trajectory.png."""
    return Evaluation("town", "", {"mine": score(file, NAMES)}, file.positions)


@pytest.fixture
def two(one):
    """Two methods; precision-recall-pairs-f1max-1-10.png is one of their plots."""
    return dataclasses.replace(one, methods={"mine": one.results, "same": one.results})


@pytest.fixture
def sessions(file):
    return evaluate_sessions(file, [dataclasses.replace(file, sequence="tuesday")])


def names_in(folder) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_plots_of_an_earlier_evaluation_go_and_other_files_stay(one, two, sessions, tmp_path):
    mine = tmp_path / "precision-recall-raw.png"
    mine.write_bytes(b"not of this command")
    for write, found in ((write_evaluation, two), (write_evaluation, one), (write_sessions, sessions)):
        written = write(found, tmp_path)
        assert names_in(tmp_path) == {mine.name, *(path.name for path in written)}
    assert len(written) == 2


NUMBERS = ["{", '{"sequence": "08", "raw": {}}', "[]", '{"results": {"a": 1}}', '{"results": [{"protocol": 3}]}', None]


@pytest.mark.parametrize("numbers", NUMBERS)
def test_where_no_evaluation_was_nothing_is_removed(sessions, tmp_path, numbers):
    (tmp_path / "trajectory.png").write_bytes(b"not of this command")
    if numbers is not None:
        (tmp_path / "results.json").write_text(numbers)
    write_sessions(sessions, tmp_path)
    assert names_in(tmp_path) == {"trajectory.png", "results.json", "report.html"}
