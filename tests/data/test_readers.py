"""Readers in the order of their rank, layouts and choices that there are not, and plain folders of scans."""

import numpy as np
import pytest

from sglpr_jax.data import readers
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.files import DataWarning

MULE = """
from sglpr_jax.data.formats.scan_files import scan_of_file
from sglpr_jax.data.readers.reader import Reader
from sglpr_jax.data.recording import Recording


def names(root):
    return tuple(sorted(path.parent.name for path in root.glob("*/scans.here")))


def open_recording(root, name, options):
    paths = tuple(sorted((root / name).glob("*.bin")))
    return Recording(name, tuple(p.stem for p in paths), paths, scan_of_file, pose_source=options.pose_source)


READER = Reader(layout="NN/scans.here (mule)", recording_names=names, open=open_recording, rank=3)
"""


@pytest.fixture
def with_another(tmp_path, monkeypatch):
    """A file added to the folder of readers."""
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "mule.py").write_text(MULE)
    monkeypatch.setattr(readers, "__path__", [*readers.__path__, str(tmp_path / "more")])
    readers.readers.cache_clear()
    yield
    readers.readers.cache_clear()


def test_the_readers_look_in_their_order():
    layouts = [reader.layout.rpartition("(")[2] for reader in readers.readers()]
    known = ["KITTI)", "BEV images)", "NCLT)", "MulRan)", "HeLiPR)", "*.bin, *.pcd, *.ply, *.npy, *.npz, *.las)"]
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


def test_points_of_images_and_images_of_scans_are_refused(kitti_root, bev_root):
    with pytest.raises(ValueError, match="sequence 06: expected scans, found ready-made images"):
        open_recording(bev_root, "06").points(0)
    with pytest.raises(ValueError, match="sequence 08: expected ready-made images, found scans"):
        open_recording(kitti_root, "08").image(0)


def test_unknown_sequences_and_layouts_say_what_exists(kitti_root, tmp_path):
    with pytest.raises(FileNotFoundError, match="kitti: expected sequence '8', found 08"):
        open_recording(kitti_root, "8")
    (kitti_root / "sequences/05/velodyne").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match="expected the name of one sequence, found 05, 08"):
        open_recording(kitti_root)
    (tmp_path / "other" / "scans").mkdir(parents=True)
    (tmp_path / "other" / "notes.txt").write_text("")
    expected = r"no known layout: 1 .txt, 1 folder \(scans\); expected sequences/NN/velodyne.*NN/imgs.*"
    with pytest.raises(FileNotFoundError, match=expected):
        recording_names(tmp_path / "other")
    with pytest.raises(FileNotFoundError, match=r"none: expected the folder of a recording, or a bag, found no such"):
        open_recording(tmp_path / "none", "08")


@pytest.mark.parametrize("name", ["pose_source", "format"])
def test_a_choice_that_there_is_not_is_told_with_those_that_there_are(as_installed, kitti_root, name):
    with pytest.raises(ValueError, match=rf"^{name}: expected one of 'auto', .*'kitti'.*, found 'kiti'$"):
        open_recording(kitti_root, **{name: "kiti"})


def write_scans(folder, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        np.full((3, 4), i, dtype="<f4").tofile(folder / name)
    return folder


def write_poses(path, positions):
    rows = np.tile(np.eye(3, 4), (len(positions), 1, 1))
    rows[:, :, 3] = positions
    np.savetxt(path, rows.reshape(-1, 12))


@pytest.mark.parametrize(
    ("names", "ids"),
    [
        (("full10", "full0", "full2", "full1", "full02"), ("full0", "full1", "full2", "full02", "full10")),
        (("1.5", "1.0", "1.75", "1.25"), ("1.0", "1.25", "1.5", "1.75")),
        (("scan_7.5", "scan_7.25", "scan_6.9"), ("scan_6.9", "scan_7.25", "scan_7.5")),
        (("b_1.5", "b_1.25", "a_1.5"), ("a_1.5", "b_1.5", "b_1.25")),
        (("2012.10.2", "2012.9.15"), ("2012.9.15", "2012.10.2")),
        (("2012.1.10", "2012.1.9"), ("2012.1.9", "2012.1.10")),
        (("part1.10", "part1.9"), ("part1.9", "part1.10")),
        (("000003", "._000003", ".old"), ("000003",)),
    ],
)
def test_numbers_in_names_sort_as_numbers_and_hidden_files_are_no_scans(tmp_path, names, ids):
    assert open_recording(write_scans(tmp_path, *(f"{name}.bin" for name in names))).ids == ids


TUM = "1.5 1 2 3 0 0 0 1\n2.5 4 5 6 0 0 0 1\n"
CSV = "timestamp,x,y,z\n1.5,1,2,3\n2.5,4,5,6\n"
TWELVE = "1 0 0 1 0 1 0 2 0 0 1 3\n1 0 0 4 0 1 0 5 0 0 1 6\n"


@pytest.mark.parametrize(
    ("name", "text", "timed"), [("a.tum", TUM, True), ("a.csv", CSV, True), ("a.txt", TWELVE, False)]
)
@pytest.mark.parametrize("beside", [True, False])
def test_poses_of_any_format_beside_the_scans_or_named(tmp_path, name, text, timed, beside):
    folder = write_scans(tmp_path / "scans", "1.bin", "2.bin")
    path = folder / name.replace("a", "poses") if beside else tmp_path / name
    path.write_text(text)
    named = {} if beside else {"poses": path, "pose_format": "auto" if timed else "lidar"}
    found = open_recording(folder, **named)
    np.testing.assert_array_equal(found.positions, [[1, 2, 3], [4, 5, 6]])
    assert (None if found.times is None else found.times.tolist()) == ([1.5, 2.5] if timed else None)
    (folder / "times.txt").write_text("1.75\n2.25\n")
    found = open_recording(folder, **named)
    assert found.times.tolist() == [1.75, 2.25]
    np.testing.assert_array_equal(found.positions[:, 0], [1.75, 3.25] if timed else [1, 4])
    assert found.pose_source.endswith(", interpolated at the times of the scans") == timed
    (tmp_path / "other.txt").write_text("2\n2\n")
    assert open_recording(folder, **named, times=tmp_path / "other.txt").times.tolist() == [2, 2]


def test_poses_and_scans_that_do_not_fit_are_refused(tmp_path, bev_root):
    folder = write_scans(tmp_path / "scans", "1.bin", "2.bin")
    (folder / "times.txt").write_text("7\n")
    with pytest.raises(ValueError, match=r"times\.txt: expected 2 rows, one per scan, found 1"):
        open_recording(folder)
    (folder / "times.txt").unlink()
    (folder / "poses.tum").write_text(TUM), (folder / "poses.csv").write_text(CSV)
    with pytest.raises(ValueError, match=r"scans: expected one pose file, found poses\.csv, poses\.tum"):
        open_recording(folder)
    with pytest.raises(FileNotFoundError, match=r"none\.txt: expected a pose file, found none"):
        open_recording(folder, poses=tmp_path / "none.txt")
    with pytest.raises(ValueError, match=r"a\.txt: expected poses or times for a plain folder of scans, .*BEV images"):
        open_recording(bev_root, "06", poses="a.txt")
    write_scans(folder, "1.pcd")
    with pytest.raises(ValueError, match=r"scans: expected one file for each scan, found 1\.bin and 1\.pcd"):
        open_recording(folder)


def test_poses_in_other_axes_than_those_of_the_layout_are_told(kitti_root, bev_root):
    drive = np.arange(4.0)[:, None] * [100, 60, 0]
    write_poses(kitti_root / "sequences/08/poses.txt", drive)  # z up instead of camera axes
    with pytest.warns(DataWarning, match=r"sequence 08: expected z up, found heights over 180 m and 0 x 300 m"):
        open_recording(kitti_root)
    write_poses(bev_root / "06/pose.txt", drive[:, [1, 2, 0]])  # camera axes instead of z up
    with pytest.warns(DataWarning, match=r"sequence 06: expected z up, found heights over 200 m and 120 x 0 m"):
        open_recording(bev_root)


def test_a_format_that_the_layout_defines_is_not_used(kitti_root, bev_root):
    for root in (kitti_root, bev_root):
        (root / "simulation.json").write_text('{"sensor": {"height_m": 1.73}}')
        with pytest.raises(ValueError, match=r"expected pose_format 'auto' for the layout .*, found 'lidar'"):
            open_recording(root, pose_format="lidar")
    assert open_recording(kitti_root.parent, "kitti/08", format="kitti").found[0].endswith(", as given")
    for root, name in ((bev_root, "06"), (bev_root.parent, "bev/06")):
        with pytest.warns(
            DataWarning, match=r"bev: expected format 'auto' for .*BEV images\), found 'kitti', not used"
        ):
            open_recording(root, name, format="kitti")


def test_what_is_left_aside_is_said(tmp_path):
    folder = write_scans(tmp_path / "scans", "1.bin", "view.jpg", "map.xyz", "times.txt.bak")
    (folder / "more").mkdir()
    aside = "left aside: 1 .bak, 1 .jpg, 1 .xyz, 1 folder (more)"
    format = "format: kitti (16 bytes a point), too few points to detect it"
    recording = open_recording(folder, sensor_height=1.7)
    assert recording.found[:2] == (format, aside)
    assert (recording.name, recording.positions, recording.times, recording.pose_source) == ("scans", None, None, None)


def test_consecutive_poses_far_apart_and_a_change_of_the_clock_are_told(tmp_path, recwarn):
    folder = write_scans(tmp_path / "scans", *(f"full{i}.bin" for i in range(30)))
    way = np.stack([np.arange(30.0) * 2, np.zeros(30), np.zeros(30)], axis=1)
    write_poses(folder / "poses.txt", way)
    open_recording(folder, sensor_height=1.7)
    assert not recwarn.list
    write_poses(folder / "poses.txt", way[np.random.default_rng(0).permutation(30)])
    with pytest.warns(DataWarning, match=r"poses\.txt: expected consecutive scans near each other, found full\d+ and"):
        open_recording(folder, sensor_height=1.7)
    way[20:] += 300
    write_poses(folder / "poses.txt", way)
    with pytest.warns(DataWarning, match=r"full19 and full20 5\d\d m apart \(1 jumps; half .* below 2\.0 m"):
        open_recording(folder, sensor_height=1.7)
    (folder / "poses.txt").unlink()
    np.savetxt(folder / "times.txt", np.arange(30) / 10 + 86400.0 * (np.arange(30) >= 7))
    said = r"scans: expected one drive, found 24 h between scans 6 and 7 \(1 jumps\); scans before and after a jump"
    with pytest.warns(DataWarning, match=said):
        open_recording(folder, sensor_height=1.7)


def test_real_folders(shared):
    samples = open_recording(shared / "data/samples")
    assert samples.ids == ("16_beams", "nuscenes_32_beams")
    assert [len(samples.points(i)) for i in range(2)] == [32000, 34688]
    assert len(open_recording(shared / "data/samples/nclt/velodyne_sync").points(0)) == 23546
