"""Leave-one-out over datasets. A model's label images beside images without labels of their own, nowhere else."""

import numpy as np
import pytest
from PIL import Image

from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.training_recordings import leave_one_out, with_pseudo_labels


def write_map(path, raw: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((5, 7), raw, np.uint16)).save(path)


def test_images_without_labels_get_pseudo_labels(bev_root, tmp_path):
    recording = open_recording(bev_root, "06")
    write_map(tmp_path / "maps/06/000001.png", 50)
    write_map(tmp_path / "maps/06/000009.png", 50)  # of no image
    (found,) = with_pseudo_labels([recording], tmp_path / "maps")
    assert found.label_paths == (None, tmp_path / "maps/06/000001.png", None)
    assert found.labels(0) is None and (found.labels(1) == 50).all()
    np.testing.assert_array_equal(found.image(1), recording.image(1))
    assert not recording.has_labels


def test_recordings_with_labels_of_their_own_and_those_without_a_map_stay_as_they_are(bev_root, kitti_root, tmp_path):
    labelled, plain = open_recording(kitti_root, "08"), open_recording(bev_root, "06")
    write_map(tmp_path / "maps/08/000000.png", 50)
    with pytest.raises(FileNotFoundError, match=r"maps: expected label images NN/<id>\.png .* \(06\), found none"):
        with_pseudo_labels([labelled, plain], tmp_path / "maps")
    with pytest.raises(FileNotFoundError, match=r"\(the data has no image recording without labels\)"):
        with_pseudo_labels([labelled], tmp_path / "maps")


def test_leave_one_out_over_several_datasets_needs_names_that_differ(bev_root, kitti_root, tmp_path):
    recordings, test = leave_one_out([kitti_root, bev_root], "08")
    assert ([recording.name for recording in recordings], test.name) == (["06"], "08")
    with pytest.raises(FileNotFoundError, match=f"{kitti_root}, {bev_root}: expected sequence '09', found 08, 06"):
        leave_one_out([kitti_root, bev_root], "08", train=("09",))
    (tmp_path / "again").symlink_to(bev_root)
    with pytest.raises(ValueError, match=f"again: expected recordings with new names, found '06', as in {bev_root}"):
        leave_one_out([bev_root, tmp_path / "again"], "06")
    with pytest.raises(ValueError, match="expected training recordings other than '06', found none"):
        leave_one_out([bev_root], "06")
