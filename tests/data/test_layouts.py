"""Layouts of datasets, written here as small trees: what is found, in which frame, at what times, and each flaw."""

import json
import pickle
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from dataset_trees import (
    DRIVE,
    HELIPR,
    NS,
    POINTS,
    US,
    boreas,
    helipr_scan,
    helipr_tree,
    mulran,
    nclt,
    nuscenes,
    pandaset,
    raw,
    write,
)
from PIL import Image

from sglpr_jax.data.fingerprint import fingerprint
from sglpr_jax.data.formats.pose_files import read_timed_rows
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.packed import packed
from sglpr_jax.data.readers import kitti_raw, mulran_helipr_boreas_nclt, open_recording, recording_names


class Layout(NamedTuple):
    write: Callable[[Path], None] | None
    name: str
    ids: tuple[str, ...]
    positions: Any
    steps_s: Any
    """Differences of the times, or None without times."""
    points: Any
    """Points of the last scan."""
    pose_source: str
    found: str
    """Beginning of the first line that the reader found."""
    lasers: Any = None
    part: str = "."
    """Folder in the tree that may be opened, too."""


LIDAR = np.array([0.021, 1.7042, 1.8047])
"""Position of MulRan's Ouster on the car, turned left."""
DEGREE_M = np.pi / 180 * kitti_raw.EARTH_M
FORWARD = np.array([1, -1, 1], np.float32)
LAYOUTS = {
    "kitti": Layout(
        None,
        "08",
        ("000000", "000002", "000003"),
        [[0, -1, -2], [20, -1, -2], [30, -1, -2]],
        [0.2, 0.1],
        150 + np.arange(20.0).reshape(5, 4)[:, :3],
        "sequences/08/poses.txt",
        "format: kitti (16 bytes a point)",
    ),
    "mulran": Layout(
        mulran,
        "KAIST01",
        (str(NS), str(NS + 10**8)),
        LIDAR + np.array([[10, 20, 3], [110, 20, 3]]),
        [0.1],
        (POINTS + 1) * [-1, -1, 1],
        "global_pose.csv (1 of 3 scans left out: no pose within 0.1 s)",
        "format: MulRan, kitti (16 bytes a point), rotated to x forward",
        part="KAIST01",
    ),
    **{
        f"helipr {sensor}": Layout(
            helipr_tree,
            f"Roundabout01-{sensor}",
            (str(mulran_helipr_boreas_nclt.AEVA_CHANGED + 1), str(mulran_helipr_boreas_nclt.AEVA_CHANGED + 1 + 10**8)),
            [[0, 2, 3], [1, 2, 3]],
            [0.1],
            POINTS + 1,
            f"{sensor}_gt.txt",
            f"format: HeLiPR's {sensor} ({struct.calcsize('<' + layout)} bytes a point)",
            [0, 1, 2],
            "Roundabout01",
        )
        for sensor, layout in HELIPR.items()
    },
    "boreas": Layout(
        boreas,
        "boreas-2020",
        (str(NS // 1000), str(NS // 1000 + 10**5)),
        [[100, 200, 70], [101, 200, 70]],
        [0.1],
        POINTS + 1,
        "lidar_poses.csv",
        "format: Boreas, float32x6 (24 bytes a point)",
        [0, 0, 0],
        part="boreas-2020",
    ),
    "kitti raw": Layout(
        raw,
        "2011_09_26_drive_0001_sync",
        ("0000000000", "0000000002"),
        [[0, 0, 0], [2e-5 * DEGREE_M * np.cos(np.radians(49)), 2e-5 * DEGREE_M, 2]],
        [0.2],
        POINTS + 2,
        "oxts (GPS)",
        "format: KITTI raw",
        part=DRIVE,
    ),
    "nclt": Layout(
        nclt,
        "2012-01-15",
        (str(US), str(US + 100_000)),
        [[4, -5, -6], [7.5, 8, -9]],  # north, west, up
        [0.1],
        POINTS,
        "groundtruth_2012-01-15.csv (1 of 3 scans left out: no pose within 0.5 s)",
        "sensor: coordinates are relative to the ground",
        [0, 0, 0],
    ),
    "nuscenes": Layout(
        nuscenes,
        "scene-0061",
        tuple(f"n015__{US + wait}" for wait in (0, 50_000, 500_000)),
        # the car looks to the left: the LiDAR's .94 m to its front are .94 m to the north
        [[100 + 10 * t, 200.94, 1.84] for t in (0, 0.05, 0.5)],
        [0.05, 0.45],
        (POINTS - 1)[:, [1, 0, 2]] * FORWARD,
        "v1.0-mini/ego_pose.json",
        "format: nuscenes (20 bytes a point), rotated to x forward",
        [0, 0, 0],
    ),
    "pandaset": Layout(
        pandaset,
        "001",
        ("00", "02"),
        [[0, 0, 0], [9, 3, 0.7]],
        [0.2],
        POINTS[:, [1, 0, 2]] * FORWARD,
        "lidar/poses.json",
        "format: PandaSet as npy, transformed from the world frame to the LiDAR frame, x forward, 1 pickles not",
        part="001",
    ),
}


@pytest.fixture
def tree(tmp_path, kitti_root):
    def made(layout: str) -> Path:
        if layout == "kitti":
            return kitti_root
        LAYOUTS[layout].write(tmp_path / "data")
        return tmp_path / "data"

    return made


WORLDS = {"nclt": "NCLT", "mulran": "MulRan", "helipr": "HeLiPR", "boreas": "Boreas"}
"""By the layout of datasets whose sequences have one frame."""


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout(tree, layout):
    expected = LAYOUTS[layout]
    root = tree(layout)
    for place in {root, root / expected.part}:
        assert expected.name in recording_names(place)
        found = open_recording(place, expected.name, sensor_height=1.8)
        assert (found.name, found.ids, found.pose_source) == (expected.name, expected.ids, expected.pose_source)
        np.testing.assert_allclose(found.positions, expected.positions, atol=1e-4)
        np.testing.assert_allclose(np.diff(found.times), expected.steps_s, atol=1e-6)
        scan = found.scan(len(found) - 1)
        np.testing.assert_allclose(scan.points, expected.points, atol=2e-5)
        assert scan.points.dtype == np.float32
        assert (None if scan.lasers is None else scan.lasers.tolist()) == expected.lasers
        assert found.found[0].startswith(expected.found)
        assert found.world == WORLDS.get(layout.split()[0], "")


def edited(file: str, change: Callable[[str], str] | Any) -> Callable[[Path], None]:
    """A change of one file: of its text, or another content."""
    return lambda root: write(root / file, change((root / file).read_text()) if callable(change) else change)


def renamed(old: str, new: str) -> Callable[[Path], Path]:
    return lambda root: (root / old).rename((root / old).with_name(new))


def late(root: Path) -> None:
    """Scans of another time."""
    for path in (root / "boreas-2020/lidar").iterdir():
        path.rename(path.with_name(f"{int(path.stem) * 2}.bin"))


def row_of(table: str, row: int, **values: object) -> Callable[[Path], None]:
    def change(text: str) -> list[dict[str, object]]:
        rows = json.loads(text)
        rows[row].update(values)
        return rows

    return edited(f"v1.0-mini/{table}.json", change)


POSES, SCANS = "KAIST01/global_pose.csv", "KAIST01/Ouster"
TRUTH, NCLT = "groundtruth_2012-01-15.csv", f"2012-01-15/velodyne_sync/{US}.bin"
STAMPS = f"{DRIVE}/velodyne_points/timestamps.txt"
BROKEN = [
    ("kitti", edited("sequences/08/poses.txt", lambda text: text[:40]), r"poses\.txt, line 1: expected 12 numbers"),
    ("kitti", edited("sequences/08/times.txt", "0\n0.1\n0.2\n"), r"times\.txt: expected at least 4 rows \(frame 3\)"),
    ("kitti", edited("simulation.json", '{"sensor": 1}'), r"simulation\.json: expected the settings of a simulated"),
    ("mulran", edited(POSES, ""), "expected rows of a time and 12 numbers, found none"),
    ("mulran", renamed(f"{SCANS}/{NS}.bin", "first.bin"), r"expected scans named by their time, .*found first\.bin"),
    ("boreas", late, r"expected poses within 0\.1 s of the scans in .*, found the nearest"),
    (
        "kitti raw",
        edited(f"{DRIVE}/oxts/data/0000000002.txt", "49 8 112"),
        r"02\.txt, line 1: expected 30 numbers",
    ),
    ("nclt", edited(TRUTH, ""), "expected rows of a time and 6 numbers, found none"),
    ("nclt", edited(TRUTH, f"{US},1,2,3,0,0,0\n{US - 1},1,2,3,0,0,0\n"), r"row 2: expected a time >= 13"),
    ("nuscenes", row_of("sample_data", 0, timestamp="noon"), "expected numbers t as 'timestamp', found others"),
    ("nuscenes", row_of("sample_data", 0, timestamp=-5), "expected timestamps in microseconds since 1970, found -5"),
    ("nuscenes", row_of("sample_data", 0, timestamp=1e30), "timestamps in microseconds since 1970, found"),
    ("nuscenes", row_of("ego_pose", 0, token="e1"), r"ego_pose\.json: expected each token once, found 1 repeated"),
    ("nuscenes", row_of("calibrated_sensor", 1, rotation=[2, 0, 0, 0]), "a rotation qx qy qz qw of length 1 in row 1"),
    ("nuscenes", row_of("sample_data", 0, filename="../LIDAR_TOP/a.pcd.bin"), "expected paths of files inside"),
    (
        "nuscenes",
        row_of("sample_data", 0, filename=f"samples/LIDAR_TOP/n015__{US}.pcd.bin"),
        "a unique id for each scan",
    ),
    (
        "pandaset",
        edited("001/lidar/poses.json", [{"position": {"x": 1}}]),
        r"poses\.json: expected 'heading' in every row",
    ),
]


@pytest.mark.parametrize(("layout", "change", "message"), BROKEN, ids=range(len(BROKEN)))
def test_each_flaw_is_named(tree, layout, change, message):
    root = tree(layout)
    change(root)
    with pytest.raises(ValueError, match=message):
        open_recording(root, LAYOUTS[layout].name, sensor_height=1.8)


def test_missing_files_are_named(tree):
    root = tree("nuscenes")
    write(root / "v1.0-trainval/scene.json", [{"token": "else", "name": one} for one in ("scene-0061", "scene-0999")])
    assert recording_names(root) == ("scene-0061", "scene-0103", "scene-0999")
    assert len(open_recording(root, "scene-0061", sensor_height=1.8)) == 3
    with pytest.raises(FileNotFoundError, match=r"v1\.0-trainval/sample\.json: expected a table, found none"):
        open_recording(root, "scene-0999")
    with pytest.raises(FileNotFoundError, match=r"none\.csv: expected a table of poses, found none"):
        read_timed_rows(root / "none.csv", columns=2)


def test_kitti_has_labels_and_two_pose_files(tree):
    root = tree("kitti")
    found = open_recording(root)
    assert found.labels(0).tolist() == [48, 49, 50, 51, 52] and found.labels(1) is None and found.has_labels
    for choice, height in (("auto", -2), ("semantickitti", -2), ("kitti", -52)):
        assert open_recording(root, pose_source=choice).positions[0, 2] == height
    for file in ("sequences/08/poses.txt", "poses/08.txt"):
        (root / file).unlink()
    found = open_recording(root)
    assert found.positions is None and found.pose_source is None and len(found.times) == 3
    with pytest.raises(FileNotFoundError, match=r"expected poses in poses/08\.txt, found none"):
        open_recording(root, pose_source="kitti")


def test_simulated_drives_know_how_high_their_sensor_stood(tree):
    root = tree("kitti")
    write(root / "simulation.json", {"sensor": {"height_m": 0.8}})
    found = open_recording(root)
    assert found.mounting == Mounting(0.8) and found.found[-1] == "sensor: 0.80 m above the ground, as simulated"
    lowered = found.points(0) - [0, 0, MODEL_HEIGHT_M - 0.8]
    np.testing.assert_allclose(found.scan(0).upright_points, lowered, rtol=1e-6)
    write(root / "simulation.json", {"sensor": {"height_m": MODEL_HEIGHT_M}})
    assert open_recording(root).mounting is None


def test_simulated_drives_of_one_route_have_one_world_by_any_sensor(tree):
    root, town = tree("kitti"), {"scenery": {"lamp_m": 9.0}, "seed": 1, "scans": 9}

    def world(**changes) -> str:
        write(root / "simulation.json", {**town, "sensor": {"height_m": 1.7}, "carrier": {"height_m": 1.0}, **changes})
        return open_recording(root).world

    first = world()
    assert first and first == world(sensor={"height_m": 0.7}) == world(carrier={"height_m": 2.0}) == world(aside_m=3.0)
    indoors = {"scenery": {"repeating": "indoors"}}
    others = [world(seed=2), world(scans=10), world(**{"drive 08": "ab"}), world(**indoors)]
    others += [world(**indoors, carrier={"height_m": 2.0}), world(sessions=["2012-01-15"])]
    assert len({first, *others}) == 7
    write(root / "simulation.json", [])
    with pytest.raises(ValueError, match=r"simulation\.json: expected the settings of a simulated dataset"):
        open_recording(root)


def test_ready_made_images(bev_root):
    (bev_root / "06/imgs/000001.png").unlink()
    (bev_root / "06/labels").mkdir()
    Image.fromarray(np.arange(35, dtype=np.uint16).reshape(5, 7) // 34 * 252).save(bev_root / "06/labels/000002.png")
    found = open_recording(bev_root)
    assert (found.name, found.ids, found.times, found.pose_source) == ("06", ("000000", "000002"), None, "06/pose.txt")
    np.testing.assert_array_equal(found.positions, [[0, 1, 2], [6, 7, 8]])
    assert found.image(1).shape == (7, 5) and found.resolution_m == 0.4 and found.labels(0) is None
    raw_ids = np.asarray(Image.open(bev_root / "06/labels/000002.png"))
    np.testing.assert_array_equal(found.labels(1), np.rot90(raw_ids, -1))
    (bev_root / "06/pose.txt").unlink()
    (bev_root / "06/imgs/000000.png").rename(bev_root / "06/imgs/000000-b.png")  # no row of a pose
    found = open_recording(bev_root)
    assert found.positions is None and found.description[-1] == "times: none; poses: none"


def test_helipr_aeva_had_no_intensity_at_first(tmp_path):
    path = tmp_path / f"{mulran_helipr_boreas_nclt.AEVA_CHANGED}.bin"
    path.write_bytes(helipr_scan("Aeva", "fffffiB"))
    np.testing.assert_array_equal(mulran_helipr_boreas_nclt.read_helipr(path, sensor="Aeva").points, POINTS)
    path.write_bytes(bytes(29))
    with pytest.raises(ValueError, match=r"expected 25 bytes for each point \(Aeva\), found 29 bytes in total"):
        mulran_helipr_boreas_nclt.read_helipr(path, sensor="Aeva")


def test_kitti_raw_without_gps(tree):
    root = tree("kitti raw")
    (root / DRIVE / "oxts/data/0000000002.txt").unlink()
    assert open_recording(root).positions is None


@pytest.mark.parametrize("place", ["2012-01-15", "ground_truth"])
def test_the_ground_truth_of_nclt_is_found_in_any_of_three_places(tree, place):
    root = tree("nclt")
    (root / place).mkdir(exist_ok=True)
    (root / TRUTH).rename(root / place / TRUTH)
    scan = open_recording(root).scan(0)
    np.testing.assert_allclose(scan.upright_points, scan.points - [0, 0, MODEL_HEIGHT_M], rtol=1e-6)


def test_long_times_keep_all_their_digits(tmp_path):
    write(tmp_path / "poses.csv", f"{NS},1\n{NS + 1}.000,2\n1.5e3,3\n")
    times, numbers = read_timed_rows(tmp_path / "poses.csv", columns=2)
    assert times.tolist() == [NS, NS + 1, 1500] and numbers.tolist() == [[1], [2], [3]]


def test_packs_and_fingerprints_follow_the_poses_of_pandaset(tree, tmp_path):
    """A heading alone is corrected: points change, while files of scans and positions stay."""
    root = tree("pandaset")
    before = open_recording(root, sensor_height=1.8)
    packed(before, tmp_path / "cache")
    rows = json.loads((root / "001/lidar/poses.json").read_text())
    rows[2]["heading"] = dict(w=1.0, x=0, y=0, z=0)
    write(root / "001/lidar/poses.json", rows)
    after = open_recording(root, sensor_height=1.8)
    assert np.abs(after.points(1) - before.points(1)).max() > 1
    np.testing.assert_array_equal(packed(after, tmp_path / "cache").points(1), after.points(1))
    assert fingerprint(after) != fingerprint(before)


class Bomb:
    """What runs when it is unpickled."""

    def __reduce__(self):
        return (Path.touch, (Path("exploded"),))


def test_no_pickle_is_opened(tree, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    root = tree("pandaset")
    for path in (root / "001/lidar").glob("*.npy"):
        path.unlink()
    (root / "001/lidar/00.pkl.gz").write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(
        ValueError, match=r"expected scans as \.npy, found 3 pickles .* docs/reference/files\.md says how"
    ):
        open_recording(root)
    np.save(root / "001/lidar/00.npy", np.array([Bomb()]), allow_pickle=True)
    with pytest.raises(ValueError, match=r"00\.npy: expected a readable \.npy file"):
        open_recording(root, sensor_height=1.8).points(0)
    assert not Path("exploded").exists()


@pytest.mark.parametrize(
    ("folder", "table"),
    [
        ("pointcloud_20m_10overlap", "pointcloud_locations_20m_10overlap.csv"),
        ("pointcloud_25m_25", "pointcloud_centroids_25.csv"),
    ],
)
def test_submaps_are_refused_with_the_reason(tmp_path, folder, table):
    run = tmp_path / "oxford" / "2014-05-19-13-20-57"
    write(run / folder / "1400505794141322.bin", np.random.default_rng(0).uniform(-1, 1, (4096, 3)))
    write(run / table, "timestamp,northing,easting\n1400505794141322,5735712.8,620084.4\n")
    for root in (run / folder, run, run.parent, tmp_path):
        assert recording_names(root) == (run.name,)
        with pytest.raises(ValueError, match=r"expected scans in metres, found submaps .* by an unknown factor"):
            open_recording(root)


def test_the_real_layouts(shared):
    root = shared / "data/kitti_odometry"
    assert recording_names(root) == ("00", "08")
    found = open_recording(root, "00")
    assert (len(found), found.ids[-1], found.pose_source) == (11, "004501", "sequences/00/poses.txt")
    labelled = [scan for scan, known in zip(found.ids, found.labelled, strict=True) if known]
    assert labelled == ["000000", "000001", "000002", "000052", "000088", "000850", "004501"]
    loop = [found.ids.index(name) for name in ("000052", "004501")]
    assert len(found.points(loop[0])) > 100_000
    assert np.linalg.norm(np.diff(found.positions[loop], axis=0)) == pytest.approx(3.00, abs=0.01)
    images = open_recording(shared / "data/kitti_bev", "06")
    assert images.positions.shape == (1101, 3)
    image = images.image(500)
    assert image.shape == (151, 151) and image.max() == pytest.approx(10.0)
    inner = np.zeros((151, 151), bool)
    inner[13:138, 13:138] = True  # the renderer's crop at 25 m
    assert not image[~inner].any()


def test_the_real_images_look_along_their_scans(shared):
    """The image of frame 0 of 00 and a rasterised scan of it, both in eq. 1's orientation, show the same walls."""
    image = open_recording(shared / "data/kitti_bev", "00").image(0) > 0
    points = open_recording(shared / "data/kitti_odometry", "00").points(0)
    points = points[points[:, 2] > -1.2]
    edges = (np.arange(152) - 75.5) * 0.4
    occupied = np.histogram2d(-points[:, 1], points[:, 0], bins=[edges, edges])[0] > 0
    covered = {
        (turns, mirrored): (occupied & np.rot90(image[::mirrored], turns)).sum() / image.sum()
        for turns in range(4)
        for mirrored in (1, -1)
    }
    assert max(covered, key=lambda seen: covered[seen]) == (0, 1) and covered[0, 1] > 0.75
