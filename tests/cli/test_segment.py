import json

import numpy as np
import pytest
from PIL import Image

from sglpr_jax.categories import RAW_NAMES

from .conftest import assert_one_line_error


@pytest.fixture
def segment(command, tmp_path):
    """Run bin/segment; return how it ended and the folder that it should have written."""

    def call(*arguments):
        return command("segment", "--out", tmp_path / "maps", *arguments), tmp_path / "maps"

    return call


def test_every_scan_gets_a_map_and_the_scores_are_those_of_the_training(segment, trained, town):
    ended, maps = segment("--weights", trained.folder, "--data", town, "--seq", "08")
    assert ended.status == 0, ended.error
    assert f"{maps}: 40 semantic maps" in ended.out
    pictures = sorted(maps.glob("0*.png"))
    assert [path.stem for path in pictures] == [f"{i:06d}" for i in range(40)]
    with Image.open(pictures[7]) as image:
        found = np.asarray(image)
    assert found.shape == (16, 16) and found.dtype == np.uint8
    assert 0 < (found == 0).mean() < 1 and found.max() < 20  # cells without a point have no class
    scores = json.loads((maps / "segmentation.json").read_text())
    assert scores == json.loads((trained.folder / "test" / "results.json").read_text())["segmentation"]
    assert f"{scores['mean_iou']:.3f}" in ended.out and scores["majority"] in ended.out
    np.testing.assert_allclose(sum(scores["shares"].values()), 1)
    assert (maps / "segmentation.png").stat().st_size > 1000


def pixels(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def test_images_get_label_maps_that_lie_on_them(segment, trained, labelled_images, images):
    ended, maps = segment("--weights", trained.folder, "--data", labelled_images, "--seq", "06")
    assert ended.status == 0, ended.error
    for frame in range(30):
        found = pixels(maps / f"{frame:06d}.png")
        empty = pixels(labelled_images / f"06/imgs/{frame:06d}.png") == 0
        empty[[0, 1, -2, -1]] = empty[:, [0, 1, 2, -3, -2, -1]] = True  # beyond the model's 16 x 16 cells
        assert found.dtype == np.uint16 and found.shape == (20, 22)
        np.testing.assert_array_equal(found == 0, empty)
        assert set(np.unique(found)) <= set(RAW_NAMES)
    scores = json.loads((maps / "segmentation.json").read_text())
    assert {name for name, share in scores["shares"].items() if share} == {"car", "building"}
    ended, maps = segment("--weights", trained.folder, "--data", images, "--seq", "06")
    assert ended.status == 0 and not (maps / "segmentation.json").exists()  # scores of the other recording


def test_cells_below_the_minimum_confidence_are_unlabelled(segment, trained, images):
    options = ("--weights", trained.folder, "--data", images, "--seq", "06")
    _, maps = segment(*options)
    every = np.stack([pixels(path) for path in sorted(maps.glob("*.png"))])
    ended, maps = segment(*options, "--min-confidence", 0.12)
    some = np.stack([pixels(path) for path in sorted(maps.glob("*.png"))])
    assert 0 < (some > 0).sum() < (every > 0).sum()
    np.testing.assert_array_equal(some, np.where(some > 0, every, 0))
    assert json.loads((maps / "command.json").read_text())["data"] == str(images)
    assert f"30 semantic maps of {(some > 0).sum() / (every > 0).sum():.0%} of the cells with points" in ended.out
    assert not (maps / "segmentation.json").exists()
    assert_one_line_error(segment(*options, "--min-confidence", 80)[0], "--min-confidence: expected", "0 up to 1", "80")
