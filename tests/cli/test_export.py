"""bin/export writes what describes places; every tool takes its weights by name too."""

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.models import shipped

from .conftest import assert_one_line_error

load = sglpr_jax.DescriptorFile.load


@pytest.fixture
def exported(command, trained, tmp_path, monkeypatch):
    """The trained weights, exported under the name `simulated` into a package folder of their own."""
    monkeypatch.setattr(shipped, "FOLDER", tmp_path / "package")
    folder = shipped.FOLDER / "simulated"
    ended = command("export", "--weights", trained.folder, "--out", folder, "--half")
    assert ended.status == 0, ended.error
    assert f"{folder}: 0." in ended.out and "MB of weights" in ended.out
    return folder


def test_tools_take_exported_weights_by_name(command, exported, trained, town, tmp_path):
    options = ("--weights", "simulated", "--data", town, "--seq", "08")
    ended = command("embed", *options, "--out", tmp_path / "08.npz")
    assert ended.status == 0, ended.error
    found, whole = load(tmp_path / "08.npz"), load(trained.folder / "test" / "sglpr-raw.npz")
    difference = np.abs(found.descriptors - whole.descriptors).max()
    assert 0 < difference < 1e-2
    ended = command("evaluate", tmp_path / "08.npz", *options)
    assert ended.status == 0, ended.error
    ended = command("stress", *options, "--out", tmp_path / "stress", "--only", "rotation-180")
    assert_one_line_error(ended, "rotation-180")  # the weights were found; this disturbance is none
    ended = command("segment", *options, "--out", tmp_path / "maps")
    assert_one_line_error(ended, "simulated: expected weights with a segmentation head, found none")


def test_float32_weights_with_the_head_are_those_of_the_run(command, trained, tmp_path):
    ended = command("export", "--weights", trained.folder, "--out", tmp_path / "out", "--keep-segmentation")
    assert ended.status == 0, ended.error
    before, after = (trained.folder / "weights", tmp_path / "out")
    assert (after / "model.safetensors").read_bytes() == (before / "model.safetensors").read_bytes()
    assert (after / "config.json").read_bytes() == (before / "config.json").read_bytes()


def test_a_folder_that_is_there_is_left_alone(command, exported, trained):
    (exported / "README.md").write_text("a card")
    ended = command("export", "--weights", trained.folder, "--out", exported)
    assert_one_line_error(ended, exported, "expected a folder that does not exist yet")
    assert (exported / "README.md").read_text() == "a card"


def test_an_image_that_does_not_fit_the_grid_is_refused(command, trained, tmp_path):
    ended = command("export", "--weights", trained.folder, "--out", tmp_path / "out", "--image", "density")
    assert_one_line_error(ended, "151 x 151 cells of 0.4 m", "found 16 x 16 cells of 3.2 m")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("tool", ["embed", "segment", "stress", "evaluate", "export"])
def test_an_unknown_name_lists_those_there_are(command, exported, trained, town, tmp_path, tool):
    file = (trained.folder / "test" / "sglpr-raw.npz",) if tool == "evaluate" else ()
    data = () if tool == "export" else ("--data", town, "--seq", "08")
    ended = command(tool, *file, "--weights", "simulatd", *data, "--out", tmp_path / "out.npz")
    assert_one_line_error(ended, "simulatd: expected a folder", "(simulated), found neither")
