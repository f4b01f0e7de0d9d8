"""Every setting of tables 4 to 7 and figure 9 is a few flags: it trains, its weights load and say what they are."""

import json
import shutil

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.cli.train import parse
from sglpr_jax.evaluation import final_test
from sglpr_jax.training import recipe
from sglpr_jax.training.metrics_log import read_metrics

from .conftest import assert_one_line_error, run_command

BACKBONE = {"backbone", "expand", "place_head"}
SETTINGS = {  # flags, the parts that have weights, the loss terms beside the triplet's
    "nor NetVLAD, 25, Dice, not turned": (
        "--model.head.cbam False --model.head.pooling mean --model.categories 25 --loss.ce-weight 0 --rotate False",
        {*BACKBONE, "segmentation_head"},
        {"dice"},
    ),
    "triplet alone": ("--loss.ce-weight 0 --loss.dice-weight 0", BACKBONE, set()),
    "RB+RS, 15": ("--model.head.input counts+labels --model.categories 15", {"place_head"}, set()),
}


def flags_of(name: str) -> list[str]:
    return SETTINGS[name][0].split()


@pytest.fixture(scope="module")
def runs(town, preset, tmp_path_factory):
    """Two steps of each setting, made when first asked for; nobody changes them."""
    made = {}

    def run(name: str):
        if name not in made:
            folder = made[name] = tmp_path_factory.mktemp("ablation") / "run"
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(final_test, "final_test", lambda *_, **__: None)
                patch.setattr(recipe, "training_recall", lambda *_: lambda _: {"score": 0.0})
                patch.setattr(final_test.LearningCurves, "on_end", lambda *_: None)
                flags = ("--data", town, "--preset", preset, "--out", folder, "--steps", 2, *flags_of(name))
                ended = run_command("train", "--seq", "08", *flags)
            assert ended.status == 0, ended.error
        return made[name]

    return run


@pytest.mark.slow
@pytest.mark.parametrize("name", SETTINGS)
def test_a_setting_trains_and_says_what_it_is(runs, name):
    folder, flags, (_, parts, terms) = runs(name), flags_of(name), SETTINGS[name]
    params = sglpr_jax.load(folder)
    assert set(params.weights) == parts
    lines = read_metrics(folder / "metrics.jsonl")
    assert [line["step"] for line in lines if "loss" in line] == [1, 2]
    assert lines[0].keys() & {"cross_entropy", "dice"} == terms
    told = json.loads((folder / "config.json").read_text())["config"]["model"]
    assert told == json.loads((folder / "weights" / "config.json").read_text())
    asked = dict(zip(flags[::2], flags[1::2], strict=True)).get("--model.categories", "20")
    assert told["categories"] == (int(asked) if terms or params.config.head.reads_labels else 0)
    has = params.weights["place_head"].keys()
    assert ("cbam" in has, "netvlad" in has) == ("no" not in name, "nor" not in name)


def test_no_categories_are_the_triplet_alone():
    """Figure 9's 0, table 5's #1 and table 7's #1 are one network."""
    none, alone = (parse(flags.split()).config for flags in ("--model.categories 0", SETTINGS["triplet alone"][0]))
    assert none.model == alone.model and none.model.classes == 0 and not none.model.segments


@pytest.mark.slow
def test_a_head_that_reads_labels_resumes_and_embeds_a_drive_with_labels_only(runs, command, town, preset, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(runs("RB+RS, 15"), folder)
    flags = ("--data", town, "--preset", preset, "--out", folder, "--resume", *flags_of("RB+RS, 15"))
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
    assert_one_line_error(ended, "needs labels", "found none in sequence 08")
    flags = ("--data", bare, "--preset", preset, "--out", tmp_path / "other", *flags_of("RB+RS, 15"))
    ended = command("train", "--seq", "08", *flags)
    assert_one_line_error(ended, "model.head.input", "sequence 08", "found 0 of 40")
    assert not (tmp_path / "other").exists()
