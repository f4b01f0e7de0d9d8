"""The comparison of learned methods, from recordings to the page, with next to no training."""

import json
import os

import jax
import pytest

import sglpr_jax
from benchmarks.learned.leaderboard_page import page_of
from sglpr_jax.models.config import model_preset

from .programs import ROOT, TINY, printed

FILES = ("train/vlp16-61", "train-images/vlp16-61", "held-out/town-37", "test/town-601")


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    folder = tmp_path_factory.mktemp("learned")
    options = ("--scans", 110, "--azimuth-steps", 90)
    printed("learned.data", "--out", folder, "--only", *FILES, *options)
    return folder


@pytest.mark.slow
def test_all_contenders_are_trained_scored_and_compared(build, tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    runs = ("--data", build, "--out", build / "runs")
    few = ("--seconds", 1000, "--images", 1024, "--search-seconds", 0.001)
    monkeypatch.setitem(os.environ, "PYTHONPATH", str(ROOT))
    printed("learned.train", *runs, "--methods", "rinet", "--seeds", 0, 1, *few)
    configs = [json.loads((build / "runs" / f"rinet-{seed}" / "config.json").read_text()) for seed in (0, 1)]
    assert len({one["settings"]["learning_rate"] for one in configs}) == 1
    preset = (*runs, "--preset", TINY, "--upright-images", 300, "--learning-rate", 1e-3)
    for images in (1050, 1100):  # the second run goes on from the first, beyond the snapshot after 1,000 images
        printed("learned.train_presets", *preset, "--images", images, "--compile-cache", tmp_path / "compiled")
    jax.config.update("jax_compilation_cache_dir", None)
    curve = (build / "runs" / "tiny-0" / "scores.jsonl").read_text().splitlines()
    upright, thousand, first, whole = (json.loads(line)["images"] for line in curve)
    assert 250 < upright <= 300 and 950 < thousand <= 1000 < first <= 1050 < whole <= 1100

    places = ("--data", build, "--runs", build / "runs", "--out", build / "scores")
    entries = ("rinet-0", "rinet@random:0", "tiny-0", f"tiny-0/weights-{upright}", "thumbnail")
    out = printed("learned.score", *entries, *places, "--only", "town-601-00", "--verify")
    assert all(f"{name}, town-601-00-rotated: top1" in out for name in entries)
    assert "verified recall" in out
    out = printed("learned.score", "thumbnail", *places, "--part", "held-out", "--only", "town-37-00")
    assert "thumbnail, town-37-00: top1" in out
    printed("learned.cost", "rinet@random:0", "sglpr", "thumbnail", "--data", build, "--out", build / "cost.json")

    kept, page, figure = (tmp_path / name for name in ("results.json", "leaderboard.md", "leaderboard.svg"))
    written = ("--kept", kept, "--page", page, "--figure", figure)
    printed("learned.leaderboard", "--build", build, *written)
    assert "`tiny-0`" in page.read_text() and "98,765" in page.read_text()
    assert "## At equal numbers of images" not in page.read_text()  # there is no run of `sglpr` yet
    copied = json.loads(kept.read_text())
    copied["scores"]["sglpr-0"] = copied["scores"]["rinet-0"]
    assert "## At equal numbers of images" in page_of(copied)
    before = page.read_text(), figure.read_text()
    printed("learned.leaderboard", "--build", tmp_path / "none", *written)
    assert (page.read_text(), figure.read_text()) == before


def test_the_paper_on_images_has_its_network_and_the_losses_of_sglpr():
    paper, ours = (sglpr_jax.preset(name) for name in (str(ROOT / "benchmarks/learned/paper-112.py"), "sglpr"))
    assert paper.model == model_preset("paper-112")
    assert (paper.loss, paper.sampling) == (ours.loss, ours.sampling)


def test_labels_are_replaced_and_scans_linked(build, tmp_path):
    printed("learned.labels", "none", "--data", build, "--out", tmp_path)
    folder = tmp_path / "test" / "town-601" / "sequences" / "00"
    assert (folder / "velodyne" / "000000.bin").is_file()
    found = sorted((folder / "labels").iterdir())
    assert len(found) == 110 and set(found[0].read_bytes()[::4]) == {50}
