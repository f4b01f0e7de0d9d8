"""One call opens any layout, and says what it expected where there is none."""

from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.data.readers import open_recording, recording_names


def test_kitti(kitti_root):
    assert recording_names(kitti_root) == ("08",)
    sequence = open_recording(kitti_root, "08", pose_source="kitti")
    assert not sequence.has_images
    assert sequence.pose_source == "poses/08.txt"


def test_bev_images(bev_root):
    assert recording_names(bev_root) == ("06",)
    assert open_recording(bev_root, "06").has_images


def test_a_folder_of_scans(tmp_path):
    np.zeros((2, 5), dtype="<f4").tofile(tmp_path / "a.bin")
    assert recording_names(tmp_path) == (tmp_path.name,)
    sequence = open_recording(tmp_path, tmp_path.name, format="nuscenes")
    assert not sequence.has_images
    assert sequence.points(0).shape == (2, 3)


def test_the_only_sequence_needs_no_name(kitti_root):
    assert open_recording(kitti_root).name == "08"
    (kitti_root / "sequences/05/velodyne").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match="expected the name of one sequence, found 05, 08"):
        open_recording(kitti_root)


def test_an_unknown_sequence_lists_those_that_exist(kitti_root, bev_root):
    with pytest.raises(FileNotFoundError, match="kitti: expected sequence '8', found 08"):
        open_recording(kitti_root, "8")
    with pytest.raises(FileNotFoundError, match="bev: expected sequence '00', found 06"):
        open_recording(bev_root, "00")


def test_an_unknown_layout_says_what_was_expected(tmp_path):
    expected = "; expected sequences/NN/velodyne.*NN/imgs.*"
    with pytest.raises(FileNotFoundError, match=rf"{tmp_path}: found no known layout: no files{expected}"):
        recording_names(tmp_path)
    (tmp_path / "scans").mkdir()
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(FileNotFoundError, match=rf"no known layout: 1 .txt, 1 folder \(scans\){expected}"):
        recording_names(tmp_path)
    with pytest.raises(
        FileNotFoundError, match=r"none: expected the folder of a recording, or a bag, found no such folder$"
    ):
        open_recording(tmp_path / "none", "08")


def test_a_single_file_is_no_recording(tmp_path):
    np.zeros((2, 4), dtype="<f4").tofile(tmp_path / "000000.bin")
    with pytest.raises(FileNotFoundError, match=r"000000\.bin: expected the folder .*, found a single file;"):
        open_recording(tmp_path / "000000.bin")
    with pytest.raises(FileNotFoundError, match=r"found a single file$"):
        recording_names(Path(__file__))


@pytest.mark.parametrize("name", ["pose_source", "format", "pose_format"])
def test_a_choice_that_there_is_not_is_told_with_those_that_there_are(as_installed, kitti_root, name):
    with pytest.raises(ValueError, match=rf"^{name}: expected one of 'auto', .*'kitti'.*, found 'kiti'$"):
        open_recording(kitti_root, **{name: "kiti"})


def test_words_that_are_no_height_of_the_sensor_are_told(as_installed, kitti_root):
    with pytest.raises(ValueError, match=r"^sensor_height: expected metres .* 'auto' or 'estimate', found 'guess'$"):
        open_recording(kitti_root, sensor_height="guess")
