import re
from pathlib import Path

import pytest

from sglpr_jax.cli import datasets, demo
from sglpr_jax.training import recipe
from sglpr_jax.training.presets import load_preset
from sglpr_jax.training.recipe import TrainResult


@pytest.fixture
def tiny_demo(monkeypatch, town, preset):
    """bin/demo on the tests' dataset and model."""
    asked = {}

    def simulate(root, **options):
        asked.update(options)
        root.parent.mkdir(parents=True, exist_ok=True)
        if not root.exists():
            root.symlink_to(town)

    monkeypatch.setattr(datasets, "simulate", simulate)
    monkeypatch.setattr(demo, "WEIGHTS", None)  # the tests' model is another one
    monkeypatch.setattr(demo, "PRESET", str(preset))
    return asked


@pytest.mark.slow
def test_the_demo_ends_with_a_table_and_its_pictures_and_can_be_run_again(command, tiny_demo, tmp_path):
    out = tmp_path / "demo"
    first = command("demo", "--out", out, "--scans", 40, "--steps", 2)
    assert first.status == 0, first.error
    assert tiny_demo["scans"] == 40
    table, pictures = first.out.split("pictures:\n")
    methods = ("top-1 F1max", "polar-fft", "untrained", "shipped", "rotated")
    for words in (*methods, "segmentation of 40 scans", "sequence 00, 40 scans"):
        assert words in table
    pictures, page = pictures.split("all on one page: ")
    assert Path(page.strip()).stat().st_size > 100_000
    paths = [Path(line.strip()) for line in pictures.splitlines()]
    assert {path.name for path in paths} >= {"segmentation.png", "trajectory.png", "trajectory-raw.png"}
    assert all(path.stat().st_size > 5000 for path in paths)
    assert out / "00" / "trajectory.png" in paths

    again = command("demo", "--out", out, "--scans", 40, "--steps", 1)
    assert again.status == 0, again.error
    assert (out / "run" / "checkpoints" / "1").is_dir() and not (out / "run" / "checkpoints" / "2").exists()


def test_a_demo_that_is_stopped_says_what_it_does_next(command, tiny_demo, random_params, tmp_path, monkeypatch):
    def train(config, recordings, *, out, **_):
        return TrainResult(random_params(config.model), out, 1, config, None)

    monkeypatch.setattr(recipe, "train", train)
    ended = command("demo", "--out", tmp_path / "demo", "--steps", 2)
    assert "stopped at step 1 of 2; the next demo restarts its training" in ended.error
    assert "--resume" not in ended.error


def test_the_demos_preset_is_what_it_trains():
    assert load_preset("demo").steps <= 1000
    assert re.search(r"bin/demo", demo.__doc__ or "")
