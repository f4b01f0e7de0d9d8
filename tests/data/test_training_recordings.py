"""A model's label images beside images that have no labels of their own, and nowhere else."""

import numpy as np
import pytest
from PIL import Image

from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.training_recordings import with_pseudo_labels


def write_map(path, raw: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((5, 7), raw, np.uint16)).save(path)


def test_images_without_labels_get_those_there_are(bev_root, tmp_path):
    recording = open_recording(bev_root, "06")
    write_map(tmp_path / "maps/06/000001.png", 50)
    write_map(tmp_path / "maps/06/000009.png", 50)  # of no image
    (found,) = with_pseudo_labels([recording], tmp_path / "maps")
    assert found.label_paths == (None, tmp_path / "maps/06/000001.png", None)
    assert found.labels(0) is None and (found.labels(1) == 50).all()
    np.testing.assert_array_equal(found.image(1), recording.image(1))
    assert not recording.has_labels


def test_drives_with_labels_of_their_own_keep_them(bev_root, kitti_root, tmp_path):
    write_map(bev_root / "06/labels/000002.png", 40)
    for name in ("06", "08"):
        write_map(tmp_path / f"maps/{name}/000000.png", 50)
    recordings = [open_recording(bev_root, "06"), open_recording(kitti_root, "08")]
    with pytest.raises(
        FileNotFoundError, match=r"maps: expected label images NN/<id>\.png .* \(the data has no image .*\)"
    ):
        with_pseudo_labels(recordings, tmp_path / "maps")


def test_a_folder_without_a_single_map_is_an_error_and_one_drive_without_is_not(bev_root, tmp_path):
    (bev_root / "06").rename(bev_root / "00")
    recordings = [open_recording(bev_root, "00")]
    write_map(tmp_path / "maps/06/000000.png", 50)
    with pytest.raises(FileNotFoundError, match=r"maps: expected label images NN/<id>\.png .* \(00\), found none"):
        with_pseudo_labels(recordings, tmp_path / "maps")
    write_map(tmp_path / "more/06/000000.png", 50)
    (bev_root / "06").symlink_to(bev_root / "00")
    first, second = with_pseudo_labels([*recordings, open_recording(bev_root, "06")], tmp_path / "more")
    assert not first.has_labels and second.has_labels
