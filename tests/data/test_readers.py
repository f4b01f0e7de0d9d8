"""A reader is a file of its own: whatever defines READER is found, in the order of its rank."""

import numpy as np
import pytest

from sglpr_jax.data import readers
from sglpr_jax.data.readers import open_recording, recording_names

MULE = """
from sglpr_jax.data.readers.reader import Reader
from sglpr_jax.data.recording import scan_record
from sglpr_jax.data.recording import Recording


def names(root):
    return tuple(sorted(path.parent.name for path in root.glob("*/scans.here")))


def open_recording(root, name, options):
    paths = tuple(sorted((root / name).glob("*.bin")))
    return Recording(name, tuple(p.stem for p in paths), paths, scan_record, pose_source=options.pose_source)


READER = Reader(layout="NN/scans.here (MulRan)", recording_names=names, open=open_recording, rank=3)
"""


@pytest.fixture
def with_another(tmp_path, monkeypatch):
    """A file added to the folder of readers."""
    folder = tmp_path / "more"
    folder.mkdir()
    (folder / "mule.py").write_text(MULE)
    monkeypatch.setattr(readers, "__path__", [*readers.__path__, str(folder)])
    readers.readers.cache_clear()
    yield
    readers.readers.cache_clear()


def test_the_readers_look_in_their_order():
    layouts = [reader.layout.rpartition("(")[2] for reader in readers.readers()]
    known = ["KITTI)", "BEV images)", "NCLT)", "*.bin, *.pcd, *.ply, *.npy, *.npz, *.las)"]
    assert [layout for layout in layouts if layout in known] == known
    assert layouts[-1] == known[-1], "single scans lie in other layouts too: that reader looks last"


def test_a_new_file_is_all_that_a_new_layout_needs(with_another, tmp_path):
    root = tmp_path / "data" / "A"
    root.mkdir(parents=True)
    (root / "scans.here").write_text("")
    np.ones((3, 4), "<f4").tofile(root / "0.bin")
    assert recording_names(root.parent) == ("A",)
    recording = open_recording(root.parent, "A", pose_source="kitti")
    assert recording.points(0).shape == (3, 3) and recording.pose_source == "kitti"
    (tmp_path / "none").mkdir()
    with pytest.raises(FileNotFoundError, match=r"found no known layout: no files; .*MulRan.*single scans"):
        recording_names(tmp_path / "none")


def test_points_of_images_and_images_of_scans_are_refused(kitti_root, bev_root):
    with pytest.raises(ValueError, match="sequence 06: expected scans, found ready-made images"):
        open_recording(bev_root, "06").points(0)
    with pytest.raises(ValueError, match="sequence 08: expected ready-made images, found scans"):
        open_recording(kitti_root, "08").image(0)


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


@pytest.mark.parametrize("name", ["pose_source", "format"])
def test_a_choice_that_there_is_not_is_told_with_those_that_there_are(as_installed, kitti_root, name):
    with pytest.raises(ValueError, match=rf"^{name}: expected one of 'auto', .*'kitti'.*, found 'kiti'$"):
        open_recording(kitti_root, **{name: "kiti"})
