"""A packed recording equals that of the files, to the bit; a pack is whole or not there, and follows its source."""

import os
import shutil

import numpy as np
import pytest

from sglpr_jax.data import packed as packing
from sglpr_jax.data.packed import packed
from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.recording import Recording


def require_same_scans(found: Recording, expected: Recording) -> None:
    """The same points and labels, bit for bit; NaN is itself."""
    assert (found.name, found.ids, found.has_labels) == (expected.name, expected.ids, expected.has_labels)
    for i in range(len(expected)):
        points, labels = expected.points(i), expected.labels(i)
        assert found.points(i).dtype == points.dtype and found.points(i).shape == points.shape
        assert found.points(i).tobytes() == points.tobytes()
        assert (found.labels(i) is None) == (labels is None)
        if labels is not None:
            np.testing.assert_array_equal(found.labels(i), labels, strict=True)


def packs(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def recording(kitti_root) -> Recording:
    """Three scans of different lengths, one without labels, with points that are not finite and an id of 16 bits."""
    folder = kitti_root / "sequences/08"
    points = np.array([[np.nan, 1, 2, 3], [np.inf, -0.0, 1e-42, 3]], "<f4")
    points.tofile(folder / "velodyne/000003.bin")
    np.array([0xFFFF, (7 << 16) + 252], "<u4").tofile(folder / "labels/000003.label")
    return open_recording(kitti_root, "08")


def test_points_and_labels_are_those_of_the_files_and_packed_once(recording, tmp_path, monkeypatch):
    told = []
    found = packed(recording, tmp_path / "cache", on_progress=told.append)
    assert told == [1, 2, 3]
    require_same_scans(found, recording)
    np.testing.assert_array_equal(found.positions, recording.positions)
    monkeypatch.setattr(packing, "_write_arrays", lambda *_: pytest.fail("packed again"))
    require_same_scans(packed(recording, tmp_path / "cache"), recording)
    assert not found.points(0).flags.writeable
    shutil.rmtree(recording.paths[0].parents[1])
    np.testing.assert_array_equal(found.points(1), 100 + np.arange(20, dtype=np.float32).reshape(5, 4)[:, :3])


def test_a_scan_whose_bytes_have_changed_is_refused_and_the_others_are_not(recording, tmp_path):
    packed(recording, tmp_path / "cache")
    (file,) = (tmp_path / "cache").rglob("points.bin")
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    found = packed(recording, tmp_path / "cache")
    np.testing.assert_array_equal(found.points(0), recording.points(0))
    with pytest.raises(ValueError, match=rf"^{file}: expected array 2 with the checksum .* pack the recording again"):
        found.points(2)


def test_images_are_those_of_the_files(bev_root, tmp_path):
    recording = open_recording(bev_root, "06")
    found = packed(recording, tmp_path / "cache")
    assert found.has_images and found.resolution_m == recording.resolution_m
    for i in range(len(recording)):
        np.testing.assert_array_equal(found.image(i), recording.image(i), strict=True)


CHANGES = {
    "time": lambda scan, label: (np.ones((5, 4), "<f4").tofile(scan), os.utime(scan, ns=(0, 0))),  # as many points
    "label": lambda scan, label: label.unlink(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_changed_source_is_packed_anew(recording, kitti_root, tmp_path, change):
    packed(recording, tmp_path / "cache")
    CHANGES[change](recording.paths[1], recording.label_paths[0])
    changed = open_recording(kitti_root, "08")
    require_same_scans(packed(changed, tmp_path / "cache"), changed)
    assert len(packs(tmp_path / "cache")) == 2


@pytest.mark.parametrize("file", ["points.bin", "pack.json"])
def test_a_damaged_pack_is_refused(recording, tmp_path, file):
    packed(recording, tmp_path / "cache")
    (path,) = (tmp_path / "cache").rglob(file)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ValueError, match=r"cache/08-.*: expected a packed recording, found a damaged one"):
        packed(recording, tmp_path / "cache")
