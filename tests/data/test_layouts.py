"""Layouts of other datasets, written here as small files: what is found, in which frame, at what times."""

import numpy as np
import pytest

from sglpr_jax.data.readers import boreas, helipr, kitti_raw, mulran, open_recording, recording_names
from sglpr_jax.data.readers.reader import ReadOptions
from sglpr_jax.data.readers.stamped import read_table

NS = 1561000444390857630
POINTS = np.array([[5.0, 1.0, -1.5], [7.0, -2.0, 0.5], [-3.0, 4.0, 2.0]], np.float32)


def write_rows(path, rows, header=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(header + "".join(",".join(map(str, row)) + "\n" for row in rows))


def write_scans(folder, names, columns):
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        np.column_stack([POINTS + i, np.zeros((3, columns - 3))]).astype("<f4").tofile(folder / f"{name}.bin")


@pytest.fixture
def mulran_root(tmp_path):
    """A sequence whose car stands at (10 i, 20, 3), turned left by a quarter; the third scan has no pose."""
    folder = tmp_path / "KAIST01"
    write_scans(folder / "Ouster", [NS, NS + 10**8, NS + 10**9], 4)
    left = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    poses = [np.column_stack([left, [10.0 * i, 20.0, 3.0]]).reshape(-1).tolist() for i in range(20)]
    write_rows(folder / "global_pose.csv", [[NS - 10**7 + i * 10**7, *pose] for i, pose in enumerate(poses)])
    return tmp_path


def test_mulran(mulran_root):
    assert recording_names(mulran_root) == recording_names(mulran_root / "KAIST01") == ("KAIST01",)
    for root in (mulran_root, mulran_root / "KAIST01"):
        recording = open_recording(root, sensor_height=1.8)
        assert recording.ids == (str(NS), str(NS + 10**8))
        lidar = [0.021, 1.7042, 1.8047]  # the Ouster's place on the car, turned left
        np.testing.assert_allclose(recording.positions, [np.add([10, 20, 3], lidar), np.add([110, 20, 3], lidar)])
        np.testing.assert_allclose(np.diff(recording.times), 0.1, atol=1e-6)
        np.testing.assert_array_equal(recording.points(0), POINTS * [-1, -1, 1])
        assert recording.pose_source == "global_pose.csv (1 of 3 scans left out: no pose within 0.1 s)"
        assert recording.found[0] == "format: MulRan, kitti (16 bytes a point), rotated to x forward"


PACKED = {
    "Avia": ("fffBBBI", 19),
    "Aeva": ("fffffiBf", 29),
    "Ouster": ("ffffIHHH", 26),
    "Velodyne": ("ffffHf", 22),
}
LINE = {"Avia": 5, "Aeva": 6, "Ouster": 6, "Velodyne": 4}
"""In which column the line is."""


def helipr_scan(sensor, layout):
    import struct

    rows = []
    for i, point in enumerate(POINTS):
        rest = [7] * (len(layout) - 3)
        rest[LINE[sensor] - 3] = i
        rows.append(struct.pack(f"<{layout}", *point, *rest))
    return b"".join(rows)


@pytest.fixture
def helipr_root(tmp_path):
    folder = tmp_path / "Roundabout01"
    for sensor, (layout, _) in PACKED.items():
        (folder / "LiDAR" / sensor).mkdir(parents=True)
        for i in range(2):
            stamp = helipr.AEVA_CHANGED + 1 + i * 10**8
            (folder / "LiDAR" / sensor / f"{stamp}.bin").write_bytes(helipr_scan(sensor, layout))
        (folder / "LiDAR_GT").mkdir(exist_ok=True)
        poses = [f"{helipr.AEVA_CHANGED + 1 + i * 10**8} {i} 2 3 0 0 0 1\n" for i in range(2)]
        (folder / "LiDAR_GT" / f"{sensor}_gt.txt").write_text("".join(poses))
    return tmp_path


@pytest.mark.parametrize("sensor", PACKED)
def test_helipr(helipr_root, sensor):
    name = f"Roundabout01-{sensor}"
    assert name in recording_names(helipr_root) and len(recording_names(helipr_root / "Roundabout01")) == 4
    recording = open_recording(helipr_root, name, sensor_height=1.8)
    record = recording.record(1, lasers=True)
    np.testing.assert_array_equal(record.points, POINTS)
    np.testing.assert_array_equal(record.lasers, [0, 1, 2])
    np.testing.assert_array_equal(recording.positions, [[0, 2, 3], [1, 2, 3]])
    assert recording.found[0] == f"format: HeLiPR's {sensor} ({PACKED[sensor][1]} bytes a point)"


def test_helipr_aeva_had_no_intensity_at_first(tmp_path):
    path = tmp_path / f"{helipr.AEVA_CHANGED}.bin"
    path.write_bytes(helipr_scan("Aeva", "fffffiB"))
    np.testing.assert_array_equal(helipr.read_points(path, sensor="Aeva").points, POINTS)
    path.write_bytes(bytes(29))
    with pytest.raises(ValueError, match=r"expected 25 bytes a point \(Aeva\), found 29 bytes in total"):
        helipr.read_points(path, sensor="Aeva")


@pytest.fixture
def boreas_root(tmp_path):
    folder = tmp_path / "boreas-2020-12-01-13-26"
    micro = NS // 1000
    write_scans(folder / "lidar", [micro, micro + 10**5], 6)
    header = "GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up,roll,pitch,heading,wz,wy,wx\n"
    rows = [[micro + i * 10**5, 100.0 + i, 200.0, 70.0, *[0.0] * 9] for i in range(2)]
    write_rows(folder / "applanix" / "lidar_poses.csv", rows, header)
    return tmp_path


def test_boreas(boreas_root):
    assert recording_names(boreas_root) == ("boreas-2020-12-01-13-26",)
    recording = open_recording(boreas_root, sensor_height=2.1)
    np.testing.assert_array_equal(recording.positions, [[100, 200, 70], [101, 200, 70]])
    np.testing.assert_array_equal(recording.points(1), POINTS + 1)
    assert recording.times[0] == pytest.approx(NS / 1e9, abs=1e-5) and recording.pose_source == "lidar_poses.csv"
    assert len(boreas.open_recording(boreas_root / recording.name, recording.name, ReadOptions())) == 2


@pytest.fixture
def raw_root(tmp_path):
    folder = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    write_scans(folder / "velodyne_points" / "data", ["0000000000", "0000000002"], 4)
    stamps = [f"2011-09-26 13:02:{25 + i / 10:012.9f}\n" for i in range(3)]
    (folder / "velodyne_points" / "timestamps.txt").write_text("".join(stamps))
    (folder / "oxts" / "data").mkdir(parents=True)
    for i in (0, 2):
        numbers = [49.0 + i * 1e-5, 8.4 + i * 1e-5, 112.0 + i, *[0.0] * 27]
        (folder / "oxts" / "data" / f"{i:010d}.txt").write_text(" ".join(map(str, numbers)))
    return tmp_path


def test_kitti_raw(raw_root):
    drive = raw_root / "2011_09_26" / "2011_09_26_drive_0001_sync"
    for root in (raw_root, raw_root / "2011_09_26", drive):
        assert recording_names(root) == (drive.name,)
    recording = open_recording(raw_root)
    assert recording.ids == ("0000000000", "0000000002") and recording.mounting is None
    degree = np.pi / 180 * kitti_raw.EARTH_M
    np.testing.assert_allclose(recording.positions[0], 0)
    np.testing.assert_allclose(
        recording.positions[1], [2e-5 * degree * np.cos(np.radians(49)), 2e-5 * degree, 2], atol=1e-4
    )
    np.testing.assert_allclose(np.diff(recording.times), 0.2, atol=1e-6)
    np.testing.assert_array_equal(recording.points(1), POINTS + 1)


def test_kitti_raw_without_gps_and_with_broken_times(raw_root):
    drive = raw_root / "2011_09_26" / "2011_09_26_drive_0001_sync"
    (drive / "oxts" / "data" / "0000000002.txt").write_text("49 8 112")
    with pytest.raises(ValueError, match=r"0000000002\.txt: expected 30 numbers, found 3"):
        open_recording(raw_root)
    (drive / "oxts" / "data" / "0000000002.txt").unlink()
    assert open_recording(raw_root).positions is None
    for text in ("2011-09-26 13:02:25.9\n", "noon\n" * 3):
        (drive / "velodyne_points" / "timestamps.txt").write_text(text)
        with pytest.raises(
            ValueError, match=r"timestamps\.txt: expected a date and time such as .* for each of 2 scans"
        ):
            open_recording(raw_root)


@pytest.mark.parametrize("reader", [mulran, boreas])
def test_what_is_missing_or_malformed_is_named(mulran_root, boreas_root, reader):
    root = mulran_root / "KAIST01" if reader is mulran else boreas_root / "boreas-2020-12-01-13-26"
    scans = root / ("Ouster" if reader is mulran else "lidar")
    poses = root / reader.POSES
    whole = poses.read_text()
    for text, message in (
        ("", "expected rows of a time and 12 numbers, found none"),
        (whole.replace("20.0", "nan").replace("200.0", "nan"), "line . ?: expected a time and 12 finite numbers"),
        (whole + "9" + ",1_0" * 12 + "\n", "expected a time and 12 finite numbers, found '9,1_0"),
        (whole + "1,2,3\n", "expected a time and 12 finite numbers, found '1,2,3'"),
    ):
        poses.write_text(text)
        with pytest.raises(ValueError, match=rf"{poses.name}.*{message.replace(' ?', '')}"):
            reader.open_recording(root, root.name, ReadOptions())
    poses.write_text(whole)
    first = next(iter(sorted(scans.iterdir())))
    odd = first.rename(scans / "first.bin")
    with pytest.raises(ValueError, match=r"expected scans named by their time, .*found first\.bin"):
        reader.open_recording(root, root.name, ReadOptions())
    odd.unlink()
    for path in scans.iterdir():
        path.rename(scans / f"{int(path.stem) * 2}.bin")
    with pytest.raises(ValueError, match=r"expected poses within 0\.1 s of the scans in .*, found the nearest"):
        reader.open_recording(root, root.name, ReadOptions())
    for path in scans.iterdir():
        path.unlink()
    with pytest.raises(FileNotFoundError, match=r"expected scans \(\*\.bin\), found none"):
        reader.open_recording(root, root.name, ReadOptions())


def test_long_times_keep_all_their_digits(tmp_path):
    (tmp_path / "poses.csv").write_text(f"{NS},1\n{NS + 1}.000,2\n1.5e3,3\n")
    times, numbers = read_table(tmp_path / "poses.csv", columns=2)
    np.testing.assert_array_equal(times, [NS, NS + 1, 1500])
    np.testing.assert_array_equal(numbers, [[1], [2], [3]])
    with pytest.raises(FileNotFoundError, match="expected a table of poses, found none"):
        read_table(tmp_path / "none.csv", columns=2)


OXFORD = ("pointcloud_20m_10overlap", "pointcloud_locations_20m_10overlap.csv")
DISTRICT = ("pointcloud_25m_25", "pointcloud_centroids_25.csv")


@pytest.mark.parametrize(("folder", "table"), [OXFORD, DISTRICT])
def test_submaps_are_refused_with_the_reason(tmp_path, folder, table):
    run = tmp_path / "oxford" / "2014-05-19-13-20-57"
    (run / folder).mkdir(parents=True)
    submap = np.random.default_rng(0).uniform(-1, 1, (4096, 3))
    submap.tofile(run / folder / "1400505794141322.bin")
    (run / table).write_text("timestamp,northing,easting\n1400505794141322,5735712.8,620084.4\n")
    for root in (run / folder, run, run.parent, tmp_path):
        assert recording_names(root) == (run.name,)
        with pytest.raises(ValueError, match=r"expected scans in metres, found submaps .* by an unknown factor"):
            open_recording(root)
