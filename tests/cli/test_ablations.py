"""Settings of tables 4 to 7 and figure 9 are flags. A head that reads labels trains, resumes and embeds."""

import json
import shutil

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.cli.runtime import parse_command
from sglpr_jax.cli.train import TrainCommand
from sglpr_jax.evaluation import final_test, learning_curves
from sglpr_jax.training import recipe
from sglpr_jax.training.config import without_untrained_head

from .conftest import assert_one_line_error, run_command

TRIPLET = "--loss.ce-weight 0 --loss.dice-weight 0"
LABELS = "--model.head.input counts+labels --model.categories 15"


@pytest.fixture
def run(town, preset, tmp_path, monkeypatch):
    """Two steps of a setting; returns the folder of the run."""

    def run(flags: str):
        with monkeypatch.context() as patch:
            patch.setattr(final_test, "final_test", lambda *_, **__: None)
            patch.setattr(recipe, "training_recall", lambda *_: lambda _: {"score": 0.0})
            patch.setattr(learning_curves.LearningCurves, "on_end", lambda *_: None)
            options = ("--data", town, "--preset", preset, "--out", tmp_path / "run", "--steps", 2, *flags.split())
            ended = run_command("train", "--seq", "08", *options)
        assert ended.status == 0, ended.error
        return tmp_path / "run"

    return run


def test_without_categories_only_the_triplet_loss_remains():
    """Figure 9's 0, table 5's #1 and table 7's #1 are one network."""
    none, alone = (
        without_untrained_head(parse_command(TrainCommand, "train", flags.split()).config)
        for flags in ("--model.categories 0", TRIPLET)
    )
    assert none.model == alone.model and none.model.classes == 0 and not none.model.segments


@pytest.mark.slow
def test_a_head_that_reads_labels_resumes_and_embeds_a_drive_with_labels_only(run, command, town, preset, tmp_path):
    folder = run(LABELS)
    assert set(sglpr_jax.load(folder).weights) == {"place_head"}
    flags = ("--data", town, "--preset", preset, "--out", folder, "--resume", *LABELS.split())
    resumed = command("train", "--seq", "08", *flags, "--steps", 3)  # to the end: the test recording has labels
    assert resumed.status == 0, resumed.error
    report = json.loads((folder / "test" / "results.json").read_text())
    assert "segmentation" not in report and report["rotated"]["sglpr"][0]["counts"]["revisits"] > 0

    options = ("--weights", folder, "--data", town, "--seq", "08", "--out", tmp_path / "08.npz")
    ended = command("embed", *options, "--rotate", "--seed", 0)
    assert ended.status == 0, ended.error
    found, tested = (
        sglpr_jax.DescriptorFile.load(path) for path in (tmp_path / "08.npz", folder / "test" / "sglpr-rotated.npz")
    )
    np.testing.assert_array_equal(found.descriptors, tested.descriptors)

    bare = tmp_path / "town"
    shutil.copytree(town, bare)
    shutil.rmtree(bare / "sequences" / "08" / "labels")
    ended = command("embed", *options[:2], "--data", bare, *options[4:], "--skip-bad")
    assert_one_line_error(ended, "sglpr needs labels beside the scans, found none in sequence 08")
    flags = ("--data", bare, "--preset", preset, "--out", tmp_path / "other", *LABELS.split())
    ended = command("train", "--seq", "08", *flags)
    assert_one_line_error(ended, "model.head.input", "sequence 08", "found 0 of 40")
    assert not (tmp_path / "other").exists()
