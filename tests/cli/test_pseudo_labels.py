"""Semantics from images: their own label images, those of a second dataset, and predicted ones."""

import json

import numpy as np
import pytest

from sglpr_jax.evaluation import final_test
from sglpr_jax.training import batch_source
from sglpr_jax.training.metrics_log import read_metrics

from .conftest import assert_one_line_error


@pytest.fixture(autouse=True)
def _no_final_test(monkeypatch):
    monkeypatch.setattr(final_test, "final_test", lambda *_, **__: None)


@pytest.fixture
def labelled_places(monkeypatch):
    """For every batch read, which of its places have labels."""
    seen, read_batch = [], batch_source.read_batch

    def noted(*arguments, **options):
        batch = read_batch(*arguments, **options)
        seen.append(batch.labelled)
        return batch

    monkeypatch.setattr(batch_source, "read_batch", noted)
    return seen


def steps_of(folder) -> list[dict]:
    return [line for line in read_metrics(folder / "metrics.jsonl") if "loss" in line]


@pytest.mark.slow
def test_pseudo_labels_and_labels_of_a_second_dataset_are_both_trained_on(
    command, images, labelled_images, trained, preset, tmp_path, labelled_places
):
    pseudo, out = tmp_path / "pseudo", tmp_path / "run"
    made = command("segment", "--weights", trained.folder, "--data", images, "--seq", "00", "--out", pseudo / "00")
    assert made.status == 0, made.error
    for frame in range(0, 30, 2):
        (pseudo / "00" / f"{frame:06d}.png").unlink()
    (pseudo / "06").mkdir()
    (pseudo / "06" / "000000.png").write_text("of the recording that is tested, and never read")
    mixed = ("--also", labelled_images, "--tuples", 3, "--also-tuples", 1)
    options = ("--seq", "06", "--data", images, "--pseudo-labels", pseudo, "--preset", preset, "--out", out, *mixed)
    ended = command("train", *options, "--steps", 2)
    assert ended.status == 0, ended.error
    assert f"15 of 30 images have labels, including those of {pseudo}" in ended.error
    assert all(line["cross_entropy"] > 0 for line in steps_of(out))
    main, also = np.concatenate(labelled_places[::2]), np.concatenate(labelled_places[1::2])
    assert main.any() and not main.all() and also.all()
    assert json.loads((out / "config.json").read_text())["pseudo_labels"] == str(pseudo)
    assert_one_line_error(command("train", *options[:4], *options[6:], "--resume"), "pseudo_labels")
