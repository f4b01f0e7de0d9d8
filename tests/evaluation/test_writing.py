"""What a folder holds after an evaluation is written to it: that evaluation alone, and what is somebody else's."""

import dataclasses

import pytest

from sglpr_jax.evaluation.page.writing import write_evaluation, write_sessions
from sglpr_jax.evaluation.scoring import Evaluation, evaluate_methods, score
from sglpr_jax.evaluation.sessions import evaluate_sessions
from sglpr_jax.files import WriteError, printable

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


@pytest.mark.slow
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


def test_a_full_disk_leaves_the_earlier_evaluation_as_it_was(one, sessions, tmp_path, small_files):
    write_sessions(sessions, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with (
        small_files(len(before["results.json"]) * 4),
        pytest.raises(WriteError, match=r"(precision-recall\.png|report\.html): cannot be written: File too large"),
    ):
        write_evaluation(one, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.slow
@pytest.mark.parametrize("name", ["[/red]<b>", "$x_{$", "n\udcff\nb\x1b[2J", "x" * 2**20])
def test_a_name_with_markup_is_printed_drawn_and_written_as_it_is(file, tmp_path, name):
    file = dataclasses.replace(file, sequence=name)
    other = dataclasses.replace(file, descriptors=file.descriptors[:, ::-1].copy())
    found = evaluate_methods({name: file, "other": other}, NAMES, file=tmp_path / "a.npz")
    across = evaluate_sessions(file, [dataclasses.replace(file, sequence=f"{name}2")])
    shown = printable(name)
    write_evaluation(found, tmp_path / "one")
    write_sessions(across, tmp_path / "sessions")
    for result, folder in ((found, "one"), (across, "sessions")):
        assert shown in str(result) or len(shown) > 20
        page = (tmp_path / folder / "report.html").read_text(encoding="utf-8")
        assert "<b>" not in page and "</red>" not in page and page.count("<h1>") == 1


def test_the_names_of_earlier_plots_stay_in_the_folder(sessions, tmp_path):
    folder = tmp_path / "precision-recall-.." / "out"
    (folder / "precision-recall-..").mkdir(parents=True)
    (folder / "mine.png").write_bytes(b"not a plot")
    (folder / "results.json").write_text('{"results": [{"protocol": "../mine"}]}')
    write_sessions(sessions, folder)
    assert (folder / "mine.png").exists()
