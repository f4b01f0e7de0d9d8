import json
import re

import pytest
from PIL import Image

import sglpr_jax
from sglpr_jax.cli.runtime import parse_command
from sglpr_jax.cli.train import TrainCommand
from sglpr_jax.models.weights import weights_hash
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.presets import load_preset

from .conftest import assert_one_line_error

METHODS = ("sglpr", "untrained", "polar-fft")


def parse(*arguments):
    return parse_command(TrainCommand, "train", list(arguments))


def test_a_run_stores_everything_that_it_printed(trained, town):
    folder, ended = trained
    assert f"run: {folder}" in ended.out and "training on 00, 05; testing on 08" in ended.error
    report = json.loads((folder / "test" / "results.json").read_text())
    for title in ("raw", "rotated"):
        assert set(report[title]) == set(METHODS)
        for method in METHODS:
            file = sglpr_jax.DescriptorFile.load(folder / "test" / f"{method}-{title}.npz")
            assert len(file) == 40 and file.sequence == "08"
            assert file.config["rotation_seed"] == (None if title == "raw" else 0)
        top1 = report[title]["sglpr"][0]
        assert top1["protocol"] == "top-1 F1max" and top1["counts"]["revisits"] > 0
        assert f"{top1['score']:.3f}" in ended.out
    segmentation = report["segmentation"]
    assert 0 <= segmentation["mean_iou"] <= 1 and segmentation["cells"] > 1000
    assert f"{segmentation['mean_iou']:.3f}" in ended.out
    for name in ("precision-recall-raw", "trajectory-raw", "precision-recall-rotated", "segmentation"):
        with Image.open(folder / "test" / f"{name}.png") as picture:
            assert min(picture.size) > 200


def test_a_run_can_be_loaded_and_stores_its_settings(trained, preset, town):
    folder = trained.folder
    params = sglpr_jax.load(folder)
    assert params.config == load_preset(str(preset)).model
    trained_file = sglpr_jax.DescriptorFile.load(folder / "test" / "sglpr-raw.npz")
    untrained_file = sglpr_jax.DescriptorFile.load(folder / "test" / "untrained-raw.npz")
    assert trained_file.weights_hash == weights_hash(params) != untrained_file.weights_hash
    settings = json.loads((folder / "config.json").read_text())
    assert settings["seq"] == "08" and settings["data"] == str(town)
    assert settings["config"]["optimizer"]["learning_rate"] == 1e-3
    lines = read_metrics(folder / "metrics.jsonl")
    assert [line["step"] for line in lines if "loss" in line] == [1, 2, 3, 4]
    assert [line["step"] for line in lines if "score" in line] == [2, 4]
    assert {"triplet", "cross_entropy", "dice"} <= lines[0].keys()
    times = [line["step"] for line in lines if {"steps_per_second", "data_wait"} <= line.keys()]
    assert times == [2, 3, 4]  # the first step is compiled
    environment = json.loads((folder / "environment.json").read_text())
    assert environment["command"].startswith("bin/train --seq 08") and environment["resumes"] == []
    assert re.search(r"[\d.]+ steps/s, [\d.]+ tuples/s, [\d.]+% of the time waiting for data", trained.ended.error)
    assert (folder / "learning-curves.png").is_file()


def test_a_run_is_not_overwritten(command, trained, town, preset):
    before = (trained.folder / "config.json").read_bytes()
    ended = command("train", "--data", town, "--preset", preset, "--out", trained.folder)
    assert_one_line_error(ended, trained.folder, "--resume", "--out")
    assert (trained.folder / "config.json").read_bytes() == before


def test_a_run_is_resumed_with_its_own_settings_only(command, trained, town, preset, tmp_path):
    options = ("--data", town, "--preset", preset, "--resume", "--out")
    ended = command("train", *options, trained.folder, "--optimizer.learning-rate", 1, "--model.backbone.embed-dim", 16)
    assert_one_line_error(ended, "config.json", "config.model.backbone.embed_dim, config.optimizer.learning_rate")
    other = command("train", "--seq", "05", *options, trained.folder)
    assert_one_line_error(other, "others: seq")
    assert_one_line_error(command("train", *options, tmp_path), tmp_path / "config.json", "expected a run to resume")


@pytest.mark.slow
def test_a_run_starts_with_the_weights_of_the_flag(command, trained, images, preset, tmp_path):
    options = ("--data", images, "--preset", preset, "--seq", "06", "--steps", 1, "--method")
    options = (*options, "--optimizer.learning-rate", "0")
    begun = command("train", *options, "--weights", trained.folder, "--out", tmp_path / "run")
    assert begun.status == 0, begun.error
    assert weights_hash(sglpr_jax.load(tmp_path / "run")) == weights_hash(sglpr_jax.load(trained.folder))
    assert set(json.loads((tmp_path / "run" / "test" / "results.json").read_text())["raw"]) == {"sglpr"}
    other = ("--model.head.clusters", 3, "--weights", trained.folder, "--out", tmp_path / "other")
    assert_one_line_error(command("train", *options, *other), "place_head/netvlad", "expected")
