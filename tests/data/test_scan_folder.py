"""A plain folder of scans, with poses or without."""

import numpy as np
import pytest

from sglpr_jax.data import readers
from sglpr_jax.data.readers import scan_folder
from sglpr_jax.data.readers.reader import ReadOptions
from sglpr_jax.data.readers.scan_folder import recording_names
from sglpr_jax.data.warning import DataWarning


def open_recording(folder, **options):
    return scan_folder.open_recording(folder, folder.name, ReadOptions(**options))


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


def test_a_folder_without_scans_is_refused(tmp_path):
    assert recording_names(tmp_path) == ()
    assert recording_names(tmp_path / "none") == ()
    with pytest.raises(FileNotFoundError, match=r"expected scans \(\*\.bin, \*\.pcd, \*\.ply, .*\), found none"):
        open_recording(tmp_path)


def test_real_folders(shared):
    samples = open_recording(shared / "data/samples")
    assert samples.ids == ("16_beams", "nuscenes_32_beams")
    assert [len(samples.points(i)) for i in range(2)] == [32000, 34688]
    nclt = open_recording(shared / "data/samples/nclt/velodyne_sync")
    assert len(nclt.points(0)) == 23546


TUM = "1.5 1 2 3 0 0 0 1\n2.5 4 5 6 0 0 0 1\n"
CSV = "timestamp,x,y,z\n1.5,1,2,3\n2.5,4,5,6\n"
TWELVE = "1 0 0 1 0 1 0 2 0 0 1 3\n1 0 0 4 0 1 0 5 0 0 1 6\n"


@pytest.mark.parametrize(
    ("name", "text", "timed"),
    [("poses.txt", TUM, True), ("poses.tum", TUM, True), ("poses.csv", CSV, True), ("poses.txt", TWELVE, False)],
)
@pytest.mark.parametrize("beside", [True, False])
def test_poses_of_any_format_beside_the_scans_or_named(tmp_path, name, text, timed, beside):
    folder = write_scans(tmp_path / "scans", "1.bin", "2.bin")
    path = (folder if beside else tmp_path) / name
    path.write_text(text)
    named = {} if beside else {"poses": path, "pose_format": "auto" if timed else "lidar"}
    found = readers.open_recording(folder, **named)
    np.testing.assert_array_equal(found.positions, [[1, 2, 3], [4, 5, 6]])
    assert (None if found.times is None else found.times.tolist()) == ([1.5, 2.5] if timed else None)
    (folder / "times.txt").write_text("1.75\n2.25\n")
    found = readers.open_recording(folder, **named)
    assert found.times.tolist() == [1.75, 2.25]
    np.testing.assert_array_equal(found.positions[:, 0], [1.75, 3.25] if timed else [1, 4])
    assert found.pose_source.endswith(", interpolated at the times of the scans") == timed
    (tmp_path / "other.txt").write_text("2\n2\n")
    assert readers.open_recording(folder, **named, times=tmp_path / "other.txt").times.tolist() == [2, 2]


def test_poses_that_do_not_fit_are_refused(tmp_path):
    folder = write_scans(tmp_path / "scans", "1.bin", "2.bin")
    (folder / "times.txt").write_text("7\n9\n")
    assert open_recording(folder).times.tolist() == [7, 9] and open_recording(folder).positions is None
    (folder / "times.txt").write_text("7\n")
    (folder / "poses.tum").write_text(TUM)
    with pytest.raises(ValueError, match=r"times\.txt: expected 2 rows, one per scan, found 1"):
        open_recording(folder)
    (folder / "times.txt").unlink()
    (folder / "poses.csv").write_text(CSV)
    with pytest.raises(ValueError, match=r"scans: expected one pose file, found poses\.csv, poses\.tum"):
        open_recording(folder)
    with pytest.raises(FileNotFoundError, match=r"none\.txt: expected a pose file, found none"):
        open_recording(folder, poses=tmp_path / "none.txt")
    images = tmp_path / "06"
    (images / "imgs").mkdir(parents=True)
    with pytest.raises(
        ValueError, match=r"a\.txt: expected poses or times for a plain folder of scans, found .*BEV images"
    ):
        readers.open_recording(tmp_path, "06", poses="a.txt")


def test_numbers_in_names_sort_as_numbers(tmp_path):
    folder = write_scans(tmp_path / "scans", "full10.bin", "full0.bin", "full2.bin", "full1.bin", "full02.bin")
    assert open_recording(folder).ids == ("full0", "full1", "full2", "full02", "full10")


def test_names_that_are_times_sort_as_times(tmp_path):
    folder = write_scans(tmp_path / "scans", *(f"1600000000.{part}.bin" for part in ("5", "0", "75", "25")))
    assert open_recording(folder).ids == tuple(f"1600000000.{part}" for part in ("0", "25", "5", "75"))
    dates = write_scans(tmp_path / "dates", "2012.10.2.bin", "2012.9.15.bin")
    assert open_recording(dates).ids == ("2012.9.15", "2012.10.2")


def test_hidden_files_are_no_scans(tmp_path):
    folder = write_scans(tmp_path / "scans", "000003.bin", "._000003.bin", ".old.pcd")
    assert open_recording(folder).ids == ("000003",)
    write_scans(tmp_path / "hidden", "._000003.bin")
    assert recording_names(tmp_path / "hidden") == ()


def test_what_is_left_aside_is_said(tmp_path):
    folder = write_scans(tmp_path / "scans", "0.pcd", "1.pcd", "view.jpg", "map.xyz", "times.txt.bak")
    (folder / "more").mkdir()
    found = open_recording(folder).found
    assert found == ("format: pcd", "left aside: 1 .bak, 1 .jpg, 1 .xyz, 1 folder (more)")
    assert open_recording(write_scans(tmp_path / "mixed", "0.pcd", "1.bin")).found == (
        "format: 1 pcd, 1 kitti (16 bytes a point), too few points to detect it",
    )


def test_two_files_of_one_scan_are_refused(tmp_path):
    folder = write_scans(tmp_path / "scans", "0.bin", "1.bin", "1.pcd")
    with pytest.raises(ValueError, match=r"scans: expected one file for each scan, found 1\.bin and 1\.pcd"):
        open_recording(folder)


def test_consecutive_poses_far_apart_are_told(tmp_path, recwarn):
    folder = write_scans(tmp_path / "scans", *(f"full{i}.bin" for i in range(30)))
    way = np.stack([np.arange(30.0) * 2, np.zeros(30), np.zeros(30)], axis=1)
    write_poses(folder / "poses.txt", way)
    open_recording(folder)
    assert not recwarn.list
    write_poses(folder / "poses.txt", way[np.random.default_rng(0).permutation(30)])
    with pytest.warns(DataWarning, match=r"poses\.txt: expected consecutive scans near each other, found full\d+ and"):
        open_recording(folder)
    way[20:] += 300
    write_poses(folder / "poses.txt", way)
    with pytest.warns(DataWarning, match=r"full19 and full20 5\d\d m apart \(1 jumps; half .* below 2\.0 m"):
        open_recording(folder)
