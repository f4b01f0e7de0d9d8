import json
import shutil

import numpy as np
import pytest
from PIL import Image

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


def test_scans_without_labels_get_maps_but_no_scores(segment, trained, town, tmp_path):
    scans = tmp_path / "my_scans"
    shutil.copytree(town / "sequences" / "08" / "velodyne", scans)
    ended, maps = segment("--weights", trained.folder, "--data", scans)
    assert ended.status == 0, ended.error
    assert len(list(maps.glob("*.png"))) == 40
    assert not (maps / "segmentation.json").exists()


def test_ready_made_images_are_refused(segment, trained, images):
    ended, maps = segment("--weights", trained.folder, "--data", images, "--seq", "06")
    assert_one_line_error(ended, images, "expected scans, found ready-made images")
    assert not maps.exists()
