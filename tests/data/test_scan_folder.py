"""A plain folder of scans, with poses or without."""

import numpy as np
import pytest

from sglpr_jax.data.readers.scan_folder import open_recording, recording_names


def write_scans(folder, *names, points=3):
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        np.full((points, 4), i, dtype="<f4").tofile(folder / name)
    return folder


def write_poses(path, positions):
    rows = np.tile(np.eye(3, 4), (len(positions), 1, 1))
    rows[:, :, 3] = positions
    np.savetxt(path, rows.reshape(-1, 12))


def test_scans_without_poses(tmp_path):
    folder = write_scans(tmp_path / "scans", "b.bin", "a.bin")
    sequence = open_recording(folder)
    assert (sequence.name, sequence.ids, len(sequence)) == ("scans", ("a", "b"), 2)
    assert (sequence.positions, sequence.times, sequence.pose_source) == (None, None, None)
    assert not sequence.has_labels
    assert sequence.labels(0) is None
    np.testing.assert_array_equal(sequence.points(0), np.ones((3, 3)))  # a.bin was written second


def test_poses_beside_the_scans(tmp_path):
    folder = write_scans(tmp_path / "scans", "1.bin", "2.bin")
    write_poses(folder / "poses.txt", [[1, 2, 3], [4, 5, 6]])
    sequence = open_recording(folder)
    assert sequence.pose_source == "poses.txt"
    np.testing.assert_array_equal(sequence.positions, [[1, 2, 3], [4, 5, 6]])


def test_each_scan_needs_a_pose(tmp_path):
    folder = write_scans(tmp_path / "scans", "1.bin", "2.bin")
    write_poses(folder / "poses.txt", np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"poses\.txt: expected 2 rows, one per scan, found 3"):
        open_recording(folder)


def test_numbers_sort_as_numbers(tmp_path):
    folder = write_scans(tmp_path / "scans", "10.bin", "9.bin", "100.bin")
    assert open_recording(folder).ids == ("9", "10", "100")


def test_the_format_is_passed_on(tmp_path):
    folder = write_scans(tmp_path / "scans", "a.bin", points=5)
    assert open_recording(folder).points(0).shape == (5, 3)
    assert open_recording(folder, format="nuscenes").points(0).shape == (4, 3)


def test_one_bad_scan_leaves_the_others(tmp_path):
    folder = write_scans(tmp_path / "scans", "a.bin", "b.bin")
    (folder / "a.bin").write_bytes(b"short")
    sequence = open_recording(folder)
    with pytest.raises(ValueError, match=r"a\.bin: expected 16 bytes"):
        sequence.points(0)
    assert sequence.points(1).shape == (3, 3)


def test_a_folder_without_scans_is_refused(tmp_path):
    assert recording_names(tmp_path) == ()
    assert recording_names(tmp_path / "none") == ()
    with pytest.raises(FileNotFoundError, match=r"expected scans \(\*\.bin, \*\.pcd\), found none"):
        open_recording(tmp_path)


def test_real_folders(shared):
    samples = open_recording(shared / "data/samples")
    assert samples.ids == ("16_beams", "nuscenes_32_beams")
    assert [len(samples.points(i)) for i in range(2)] == [32000, 34688]
    nclt = open_recording(shared / "data/samples/nclt/velodyne_sync")
    assert len(nclt.points(0)) == 23546
