"""Ready-made images whose poses are not known: descriptors and loops need none, scores do."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from .conftest import assert_one_line_error


@pytest.fixture
def pictures(tmp_path) -> Path:
    """Three images of as many cells as the models read."""
    folder = tmp_path / "pictures" / "06" / "imgs"
    folder.mkdir(parents=True)
    for frame, picture in enumerate(np.random.default_rng(0).integers(0, 255, (3, 202, 202), np.uint8)):
        Image.fromarray(picture * (picture > 200)).save(folder / f"{frame:06d}.png")
    return folder.parents[1]


def test_descriptors_are_written_and_scores_ask_for_poses(command, pictures, tmp_path):
    out = tmp_path / "06.npz"
    ended = command("embed", "--method", "polar-fft", "--data", pictures, "--out", out)
    assert ended.status == 0, ended.error
    assert "3 images" in ended.error and "poses: none" in ended.error
    assert_one_line_error(
        command("evaluate", out), "06.npz: expected positions to score against, found", "without poses"
    )
