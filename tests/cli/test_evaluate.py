"""bin/evaluate on descriptor files and on what other programs write: .npy, top-k lists, scored pairs, poses."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sglpr_jax.cli.evaluate import _default_folder
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

from .conftest import assert_one_line_error

FRAMES = 400
FILES = ("results.json", "precision-recall.png", "trajectory.png", "report.html", "command.json")


@pytest.fixture(scope="session")
def laps(tmp_path_factory):
    """Two equal laps: a descriptor file, and descriptors, poses, times and lists of other programs."""
    folder = tmp_path_factory.mktemp("laps")
    angle = np.arange(FRAMES) * (4 * np.pi / FRAMES)
    x, y, times = 200 * np.cos(angle), 200 * np.sin(angle), np.arange(FRAMES) * 0.5
    zeros, ones = np.zeros(FRAMES), np.ones(FRAMES)
    descriptors, positions = np.stack([x, y], axis=1) / 200, np.stack([x, y, zeros], axis=1)
    ids = tuple(f"{i:06d}" for i in range(FRAMES))
    about = ("sequences/08/poses.txt", {"method": "made up"}, "abc")
    DescriptorFile("08", ids, positions, times, descriptors.astype(np.float32), *about).save(folder / "08.npz")
    descriptors[[250, 251]] = descriptors[[10, 11]]  # the surest mistake
    np.save(folder / "mine.npy", descriptors)
    np.save(folder / "blind.npy", np.random.default_rng(0).normal(size=(FRAMES, 8)))
    np.savetxt(
        folder / "lidar.txt", np.stack([ones, zeros, zeros, x, zeros, ones, zeros, y, zeros, zeros, ones, zeros], 1)
    )
    np.savetxt(folder / "times.txt", times)
    np.savetxt(folder / "tum.txt", np.stack([times, x, y, zeros, zeros, zeros, zeros, ones], axis=1))
    np.savetxt(folder / "poses.csv", np.column_stack([times, positions]), delimiter=",", header="t,x,y,z", comments="")
    later = range(FRAMES // 2, FRAMES)
    (folder / "topk.txt").write_text("".join(f"{i}: {i - FRAMES // 2}=0.5 3=0.1\n" for i in later))
    pairs = "".join(f"{i} {i - FRAMES // 2} 0.5 1\n{i} {i - 100} {0.6 if i == 250 else 0.1} 0\n" for i in later)
    (folder / "pairs").write_text(pairs)
    (folder / "cut.npz").write_bytes(b"PK\3\4")
    return folder


@pytest.fixture
def score(command, laps, tmp_path):
    """Run bin/evaluate on a file of `laps`; return how it ended and the folder that it wrote."""

    def score(name, *arguments):
        return command("evaluate", laps / name, "--out", tmp_path / "out", *arguments), tmp_path / "out"

    return score


def results(folder):
    return {entry["protocol"]: entry for entry in json.loads((folder / "results.json").read_text())["results"]}


@pytest.mark.slow
def test_every_protocol_is_printed_written_and_drawn(score):
    ended, folder = score("08.npz", "--published")
    assert ended.status == 0, ended.error
    for words in ("top-1 F1max", "pairs F1max", "Recall@1", "sequences/08/poses.txt", "published F1max", "real KITTI"):
        assert words in ended.out
    written = [Path(path) for path in re.findall(r"^written: (.*)$", ended.out, re.MULTILINE)]
    assert written == [folder / name for name in FILES]
    report = json.loads((folder / "results.json").read_text())
    assert [result["score"] for result in report["results"]] == [1, 1, 1]
    assert report["weights_hash"] == "abc" and report["config"] == {"method": "made up"}
    assert ["DiSCO", "0.903", "its own paper"] in report["published"]
    for path in written[1:3]:
        with Image.open(path) as picture:
            assert min(picture.size) > 200


def test_a_top_k_list_and_scored_pairs(score, command, laps, tmp_path):
    ended, folder = score("topk.txt", "--poses", laps / "poses.csv")
    assert ended.status == 0, ended.error
    assert results(folder)["top-1 F1max"]["score"] == 1 and "pairs F1max" not in results(folder)
    shutil.copy(laps / "pairs", tmp_path)
    ended, folder = command("evaluate", tmp_path / "pairs"), tmp_path / "pairs-results"  # a folder of another name
    assert ended.status == 0, ended.error
    listed = results(folder)["listed pairs F1max"]
    assert listed["counts"] == {"positive pairs": 200, "negative pairs": 200}
    assert listed["score"] == pytest.approx(400 / 401)


def test_the_default_folder_is_no_folder_of_scans(tmp_path):
    file, folder, other = tmp_path / "08.npz", tmp_path / "08", tmp_path / "08-results"
    assert _default_folder(file) == folder
    folder.mkdir()
    (folder / "results.json").touch()
    assert _default_folder(file) == _default_folder(folder) == other  # also for a file without a suffix
    (folder / "report.html").touch()
    assert _default_folder(file) == folder  # results are written again


def test_methods_are_compared_on_one_page(score, laps):
    compare = ("--poses", laps / "tum.txt", "--compare", laps / "blind.npy", laps / "topk.txt", "--distance", "l2")
    ended, folder = score("mine.npy", *compare, "--protocol", "top1-f1max", "bevplace-recall-at-1")
    assert ended.status == 0, ended.error
    report = json.loads((folder / "results.json").read_text())
    assert list(report["compared"]) == ["blind", "topk"]
    assert report["compared"]["blind"][0]["score"] < 0.5 < report["results"][0]["score"]
    text = (folder / "report.html").read_text()
    assert "Methods side by side" in text and "<td>blind</td>" in text
    assert (folder / "precision-recall-top-1-f1max.png").is_file()
    assert_one_line_error(score("mine.npy", *compare)[0], "topk", "for a top-k list", "found pairs-f1max")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("mine.npy", "--poses", "lidar.txt"), ("lidar.txt", "--pose-format", "kitti (camera axes) or lidar")),
        (
            ("mine.npy", "--poses", "tum.txt", "--protocol", "top1"),
            ("expected a protocol, found 'top1'", "'top1-f1max'"),
        ),
        (("mine.npy", "--poses", "tum.txt", "--weights", "run"), ("run", "expected --data with --weights")),
        (("cut.npz",), ("cut.npz: expected a descriptor file",)),
        (("08.npz", "mine.npy"), ("--database", "--compare")),
        (("08.npz", "--protocol", "bevplace-nclt-recall"), ("expected --database", "bevplace-nclt-recall")),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(score, laps, arguments, words):
    ended, folder = score(*(laps / word if re.search(r"\.(txt|csv)$", word) else word for word in arguments))
    assert_one_line_error(ended, *words)
    assert not folder.exists()


@pytest.mark.slow
def test_data_and_weights_add_pictures(command, trained, town, tmp_path):
    np.save(tmp_path / "blind.npy", np.ones((40, 2)))  # every query is answered, mostly with another place
    options = ("--data", town, "--seq", "08", "--protocol", "top1-f1max")
    ended = command("evaluate", tmp_path / "blind.npy", *options)
    assert ended.status == 0, ended.error
    page = (tmp_path / "blind" / "report.html").read_text()
    mistakes = json.loads((tmp_path / "blind" / "results.json").read_text())["false_positives"]
    assert page.count("from above") == 2 * len(mistakes) > 0
    assert "Semantic maps: add --weights" in page and "Feature heat maps: add --weights" in page
    assert results(tmp_path / "blind")["top-1 F1max"]["poses"] == "sequences/08/poses.txt"

    embedded = command(
        "embed", "--weights", trained.folder, "--data", town, "--seq", "08", "--out", tmp_path / "08.npz"
    )
    assert embedded.status == 0, embedded.error
    ended = command("evaluate", tmp_path / "08.npz", *options, "--weights", trained.folder)
    assert ended.status == 0, ended.error
    page = (tmp_path / "08" / "report.html").read_text()
    assert page.count("semantic map of frame") == page.count("feature heat maps of frame") == 2
    assert "add --weights" not in page
    np.save(tmp_path / "short.npy", np.ones((39, 2)))
    assert_one_line_error(command("evaluate", tmp_path / "short.npy", *options), "short.npy", "expected 40", "found 39")
