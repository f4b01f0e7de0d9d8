"""bin/evaluate on what other programs write: .npy, top-k lists, scored pairs, poses in every format."""

import json
import re

import numpy as np
import pytest

from .conftest import assert_one_line_error

FRAMES = 400


@pytest.fixture(scope="session")
def laps(tmp_path_factory):
    """Two equal laps, written as another program would: descriptors, poses in four formats, times, lists."""
    folder = tmp_path_factory.mktemp("laps")
    angle = np.arange(FRAMES) * (4 * np.pi / FRAMES)
    x, y, times = 200 * np.cos(angle), 200 * np.sin(angle), np.arange(FRAMES) * 0.5
    descriptors = np.stack([x, y], axis=1) / 200
    descriptors[[250, 251]] = descriptors[[10, 11]]  # the surest mistake
    np.save(folder / "mine.npy", descriptors)
    np.save(folder / "blind.npy", np.random.default_rng(0).normal(size=(FRAMES, 8)))
    zeros, ones = np.zeros(FRAMES), np.ones(FRAMES)
    lidar = np.stack([ones, zeros, zeros, x, zeros, ones, zeros, y, zeros, zeros, ones, zeros], axis=1)
    np.savetxt(folder / "lidar.txt", lidar)
    np.savetxt(folder / "times.txt", times)
    np.savetxt(folder / "tum.txt", np.stack([times, x, y, zeros, zeros, zeros, zeros, ones], axis=1))
    header, rows = "t,x,y,z", np.stack([times, x, y, zeros], axis=1)
    np.savetxt(folder / "poses.csv", rows, delimiter=",", header=header, comments="")
    later = range(FRAMES // 2, FRAMES)
    (folder / "topk.txt").write_text("".join(f"{i}: {i - FRAMES // 2}=0.5 3=0.1\n" for i in later))
    pairs = "".join(f"{i} {i - FRAMES // 2} 0.5 1\n{i} {i - 100} {0.6 if i == 250 else 0.1} 0\n" for i in later)
    (folder / "pairs.txt").write_text(pairs)
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
def test_a_top_k_list_and_scored_pairs(score, laps):
    ended, folder = score("topk.txt", "--poses", laps / "poses.csv")
    assert ended.status == 0, ended.error
    assert results(folder)["top-1 F1max"]["score"] == 1 and "pairs F1max" not in results(folder)
    ended, folder = score("pairs.txt")
    assert ended.status == 0, ended.error
    listed = results(folder)["listed pairs F1max"]
    assert listed["counts"] == {"positive pairs": 200, "negative pairs": 200}
    assert listed["score"] == pytest.approx(400 / 401)
    assert "pairs.txt: scored pairs with labels" in (folder / "report.html").read_text()


def test_methods_are_compared_on_one_page(score, laps):
    ended, folder = score("mine.npy", "--poses", laps / "tum.txt", "--compare", laps / "blind.npy", laps / "topk.txt",
                          "--protocol", "top1-f1max", "bevplace-recall-at-1", "--distance", "l2")  # fmt: skip
    assert ended.status == 0, ended.error
    report = json.loads((folder / "results.json").read_text())
    assert list(report["compared"]) == ["blind", "topk"]
    assert report["compared"]["blind"][0]["score"] < 0.5 < report["results"][0]["score"]
    text = (folder / "report.html").read_text()
    assert "Methods side by side" in text and "<td>blind</td>" in text
    assert (folder / "precision-recall-top-1-f1max.png").is_file()
    ended, _ = score("mine.npy", "--poses", laps / "tum.txt", "--compare", laps / "topk.txt")
    assert_one_line_error(ended, "topk", "for a top-k list", "found pairs-f1max")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("mine.npy",), ("mine.npy", "--poses", "found none")),
        (("mine.npy", "--poses", "lidar.txt"), ("lidar.txt", "--pose-format kitti", "or lidar")),
        (
            ("mine.npy", "--poses", "tum.txt", "--protocol", "top1"),
            ("expected a protocol, found 'top1'", "'top1-f1max'"),
        ),
        (("mine.npy", "--times", "times.txt"), ("times.txt", "expected --poses with --times")),
        (("mine.npy", "--poses", "tum.txt", "--weights", "run"), ("run", "expected --data with --weights")),
        (("pairs.txt", "--poses", "one.csv"), ("pairs.txt, line 1", "expected frames from 0 to 0", "found 200")),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(score, laps, arguments, words):
    (laps / "one.csv").write_text("x,y,z\n1,2,3\n")
    ended, folder = score(*(laps / word if re.search(r"\.(txt|csv)$", word) else word for word in arguments))
    assert_one_line_error(ended, *words)
    assert not folder.exists()


def test_a_list_without_an_ending_gets_a_folder_of_another_name(command, laps, tmp_path):
    (tmp_path / "pairs").write_bytes((laps / "pairs.txt").read_bytes())
    ended = command("evaluate", tmp_path / "pairs")
    assert ended.status == 0, ended.error
    assert (tmp_path / "pairs-results" / "report.html").is_file()


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


@pytest.mark.slow
def test_ready_made_images_give_heat_maps_and_semantic_maps(command, trained, images, tmp_path):
    np.save(tmp_path / "a.npy", np.eye(30))
    ended = command("evaluate", tmp_path / "a.npy", "--data", images, "--seq", "06", "--weights", trained.folder)
    assert ended.status == 0, ended.error
    page = (tmp_path / "a" / "report.html").read_text()
    assert page.count("semantic map of frame") == page.count("feature heat maps of frame") == 2
    np.save(tmp_path / "a.npy", np.eye(29))
    assert_one_line_error(
        command("evaluate", tmp_path / "a.npy", "--data", images, "--seq", "06"), "a.npy", "expected 30", "found 29"
    )
