"""Simulated datasets on disk and on the fly: layouts, the same bytes for the same seed, resumable, whole or missing."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.data.density_image import density_image, density_label_image
from sglpr_jax.data.formats.pose_files import read_kitti
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.submap import submaps
from sglpr_jax.sim import recording
from sglpr_jax.sim.dataset import simulate
from sglpr_jax.sim.drive import CARRIERS
from sglpr_jax.sim.layouts import vary
from sglpr_jax.sim.recording import simulate_recording, simulate_repeating
from sglpr_jax.sim.sensor import SENSORS, Sensor, scan
from sglpr_jax.sim.world import build_world

TINY = Sensor(elevations_deg=(2.0, -2.0, -6.0, -10.0, -14.0, -18.0, -21.0, -24.0), azimuth_steps=60)
SCANS = 4
TOWNS = {}


@pytest.fixture(autouse=True)
def _towns_are_built_once(monkeypatch):
    """Except those of `dataset` and `drive`, which are made before."""

    def built(seeds, xy, times, **options):
        key = seeds, xy.tobytes(), times.tobytes(), *map(id, options.values())
        return TOWNS.get(key) or TOWNS.setdefault(key, build_world(seeds, xy, times, **options))

    monkeypatch.setattr(recording, "build_world", built)


def write(root: Path, **changes) -> Path:
    return simulate(root, **({"routes": ("00", "08"), "scans": SCANS, "sensor": TINY, "seed": 1} | changes)).root


def content(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("town") / "data")


@pytest.fixture(scope="module")
def drive():
    return simulate_recording("08", scans=SCANS, sensor=TINY, seed=1)


@pytest.fixture
def pose_file(tmp_path) -> Path:
    """A camera that goes straight on, along its z axis, 0.5 m a line."""
    rows = np.tile(np.eye(3, 4), (150, 1, 1))
    rows[:, 2, 3] = 0.5 * np.arange(150)
    np.savetxt(tmp_path / "campus.txt", rows.reshape(150, 12))
    return tmp_path / "campus.txt"


def test_poses_times_and_calibration_are_kittis(dataset, drive):
    folder = dataset / "sequences" / "08"
    poses = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(read_kitti(folder / "poses.txt")[:, :3, 3], drive.positions, atol=1e-5)
    np.testing.assert_allclose(np.loadtxt(folder / "times.txt"), drive.times, rtol=1e-5)
    rows = dict(line.split(":") for line in (folder / "calib.txt").read_text().splitlines())
    camera_from_lidar = np.array(rows["Tr"].split(), float).reshape(3, 4)
    np.testing.assert_array_equal(camera_from_lidar, [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
    # KITTI's camera looks along z: where x of the LiDAR points.
    expected = camera_from_lidar[:, :3] @ drive.poses.world_from_lidar[:, :3, 0, None]
    np.testing.assert_allclose(poses[:, :, 2:3], expected, atol=1e-6)


def test_a_drive_on_the_fly_is_the_one_on_disk(dataset, drive):
    on_disk = open_recording(dataset, "08")
    assert not drive.has_images and drive.has_labels
    assert drive.ids == on_disk.ids == tuple(f"{i:06d}" for i in range(SCANS)) and drive.name == "08"
    for i in range(SCANS):
        np.testing.assert_array_equal(drive.points(i), on_disk.points(i))
        np.testing.assert_array_equal(drive.labels(i), on_disk.labels(i))
        assert 200 < len(drive.points(i)) <= 480 and drive.labels(i).min() > 0


def test_points_and_labels_of_a_scan_cost_one_rendering(monkeypatch, drive):
    rendered = []
    monkeypatch.setattr(recording, "scan", lambda *a, **k: rendered.append(k["time"]) or scan(*a, **k))
    drive.render.cache_clear()
    assert len(drive.points(1)) == len(drive.labels(1)) and len(drive.points(2)) == len(drive.labels(2))
    assert rendered == [drive.times[1], drive.times[2]]


@pytest.mark.slow
def test_drives_can_be_added_and_do_not_depend_on_each_other(dataset, tmp_path):
    root = write(tmp_path / "grown", routes=("08",))
    kept = (root / "sequences" / "08" / "velodyne" / "000000.bin").stat().st_mtime_ns
    assert content(write(root, routes=("00",))) == content(dataset)
    assert (root / "sequences" / "08" / "velodyne" / "000000.bin").stat().st_mtime_ns == kept


@pytest.mark.slow
def test_an_interrupted_run_is_resumed_and_its_progress_is_reported(dataset, tmp_path):
    started, done = [], []

    def interrupt(scans: int) -> None:
        if scans == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "cut", on_progress=interrupt)
    assert not (tmp_path / "cut" / "sequences" / "00" / "poses.txt").exists()
    kept = next((tmp_path / "cut").rglob("000000.bin"))
    written_ns = kept.stat().st_mtime_ns
    write(tmp_path / "cut", on_start=lambda found: started.append((found.missing, str(found))), on_progress=done.append)
    assert started == [(("00", "08"), f"{tmp_path / 'cut'}: recordings 00, 08")]
    assert done == sorted(done) and done[-1] == 2 * SCANS
    assert content(tmp_path / "cut") == content(dataset) and kept.stat().st_mtime_ns == written_ns


def test_a_finished_dataset_builds_no_town(dataset, monkeypatch):
    monkeypatch.setattr(recording, "build_world", None)
    before, missing = content(dataset), []
    write(dataset, on_start=lambda found: missing.append((found.missing, found.missing_bytes)))
    assert content(dataset) == before and missing == [((), 0)]


def test_along_a_pose_file_distances_are_the_files(tmp_path, pose_file):
    options = {"routes": (), "along": (pose_file,), "scans": 8}
    root = write(tmp_path / "along", **options)
    drive, before = open_recording(root, "campus"), content(root)
    assert len(drive) == 8  # every 19th of 150
    np.testing.assert_allclose(drive.positions[:, :2], np.outer(9.5 * np.arange(8), [1, 0]), atol=1e-6)
    np.testing.assert_allclose(drive.times, 1.9 * np.arange(8), atol=1e-6)
    on_the_fly = simulate_recording(along=pose_file, scans=8, sensor=TINY, seed=1)
    np.testing.assert_array_equal(on_the_fly.points(3), drive.points(3))
    poses = np.loadtxt(pose_file)
    poses[:, 3::4] *= 1.1
    np.savetxt(pose_file, poses)
    with pytest.raises(ValueError, match=r"simulation.json belongs to another.*drive campus"):
        write(root, **options)
    assert content(root) == before


@pytest.mark.slow
@pytest.mark.parametrize("varied", [False, True])
def test_images_are_those_of_the_scans(tmp_path, drive, varied):
    root = write(tmp_path / "images", routes=("08",), images=True, vary=varied)
    pictures = [f"08/{what}/{i:06d}.png" for what in ("imgs", "labels") for i in range(SCANS)]
    assert sorted(content(root)) == [*pictures, "08/pose.txt", "simulation.json"]
    images = open_recording(root, "08")
    np.testing.assert_allclose(images.positions, drive.positions, atol=1e-5)
    for i in range(SCANS):
        points, labels = drive.points(i), drive.labels(i)
        points, labels = vary(points, labels, None) if varied else (points, labels)
        expected = np.rot90(density_image(points), -1) * np.float32(10 / 255)
        np.testing.assert_array_equal(images.image(i), expected)
        shown = np.rot90(density_label_image(points, labels), -1)
        np.testing.assert_array_equal(images.labels(i), np.where(expected > 0, shown, 0))
        assert expected.max() > 0


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"seed": 2}, r"seed 2 \(found 1\)"),
        ({"scenery": "outskirts"}, "scenery .*walled"),
    ],
)
def test_other_settings_are_refused(dataset, changes, found):
    before = content(dataset)
    with pytest.raises(ValueError, match=f"simulation.json belongs to another.*{found}"):
        write(dataset, **changes)
    assert content(dataset) == before


def test_files_that_were_not_simulated_are_never_written_among(tmp_path):
    (tmp_path / "sequences" / "00").mkdir(parents=True)
    with pytest.raises(ValueError, match="not simulated"):
        write(tmp_path)
    assert content(tmp_path) == {}


@pytest.mark.slow
def test_a_full_disk_is_one_clear_error_and_leaves_only_whole_files(dataset, tmp_path, small_files):
    """The limit on the size of a file stands in for the disk: writing fails half-way."""
    with small_files(3000), pytest.raises(OSError, match=r"velodyne/00000\d.bin: cannot be written"):
        write(tmp_path / "full")
    whole = content(dataset)
    assert all(whole[name] == data for name, data in content(tmp_path / "full").items())
    assert content(write(tmp_path / "full")) == whole


def test_a_drive_aside_shows_the_same_town_from_another_lane(dataset, drive, tmp_path):
    aside = open_recording(write(tmp_path / "aside", routes=("08",), aside_m=3.0), "08")
    usual = open_recording(dataset, "08")
    assert aside.world == usual.world != ""
    offset = (aside.positions - usual.positions)[:, :2]
    np.testing.assert_allclose(offset, 3.0 * drive.poses.world_from_lidar[:, :2, 1], atol=0.05)  # to the left
    assert len(aside.points(0)) != len(usual.points(0))
    with pytest.raises(ValueError, match=r"expected aside_m 0\.0 \(found 3\.0\)"):
        write(tmp_path / "aside", routes=("00",))


def test_submaps_of_a_carrier_in_a_scenery_where_places_repeat(tmp_path):
    options = {"routes": ["08"], "scans": 4, "sensor": "vlp16", "azimuth_steps": 40, "scenery": "tunnel"}
    found = simulate(tmp_path, **options, submap_m=1000.0, carrier="cart")
    sensor = dataclasses.replace(SENSORS["vlp16"], azimuth_steps=40)
    drive = simulate_repeating("tunnel", scans=4, sensor=sensor, revisit="opposite", carrier=CARRIERS["cart"])
    expected = submaps(drive, drive.poses.world_from_lidar, length_m=1000.0)
    written = open_recording(found.root, "08")
    assert written.mounting == drive.mounting == Mounting(0.6)  # of the cart
    assert written.positions == pytest.approx(drive.positions, abs=1e-5)
    for i in range(4):
        np.testing.assert_array_equal(written.points(i), expected.points(i))
        np.testing.assert_array_equal(written.scan(i).labels, expected.scan(i).labels)
    assert len(written.points(3)) > len(drive.points(3))


@pytest.mark.parametrize(("scenery", "height_m"), [("rooms", 0.5), ("forest", 1.6)])
def test_the_sensor_has_the_height_of_the_scenery(tmp_path, scenery, height_m):
    options = {"routes": ["08"], "scans": 2, "sensor": "vlp16", "azimuth_steps": 200, "scenery": scenery}
    found = simulate(tmp_path, **options)
    assert open_recording(found.root, "08").mounting == Mounting(height_m)


def test_the_tilt_of_a_sensor_in_a_hand_is_seen_in_its_scans(tmp_path):
    options = {"routes": ["08"], "scans": 12, "sensor": "vlp16", "azimuth_steps": 400, "carrier": "handheld"}
    root = simulate(tmp_path / "walk", **options).root
    for walk in (open_recording(root, "08"), open_recording(tmp_path, "walk/08")):
        assert walk.mountings is not None and "tilts" in " ".join(walk.found)
        assert "as simulated" not in " ".join(walk.found)
    stated = open_recording(tmp_path, "walk/08", sensor_height=1.4)
    assert stated.mountings is None and stated.mounting == Mounting(1.4)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"routes": ["99"]}, "expected drives among 00, .* found \\['99'\\]"),
        ({"rate_hz": float("nan")}, "rate_hz: expected scans per second, more than 0, found nan"),
        ({"vary": True}, "vary: expected images, found scans"),
        ({"sensor": "vlp17"}, "expected a sensor among hdl64e, .* found 'vlp17'"),
        ({"sessions": ["2012-01-15"], "submap_m": 5.0, "routes": None}, "expected no submaps"),
        ({"sessions": ["2012-01-15"], "aside_m": 5.0, "routes": None}, "usual line, found 5 m aside"),
        ({"aside_m": float("nan")}, "aside_m: expected metres, found nan"),
        ({"scenery": "forest", "routes": ["00", "05"]}, "different revisits"),
    ],
)
def test_invalid_arguments_are_refused_before_anything_is_written(tmp_path, changes, error):
    told = []
    with pytest.raises(ValueError, match=error):
        write(tmp_path / "town", **changes, on_start=told.append)
    assert not told and not (tmp_path / "town").exists()


def test_a_folder_that_is_removed_meanwhile_is_named(tmp_path):
    """After the last scan, and before the poses of the drive."""

    def remove(done: int) -> None:
        if done == SCANS:
            shutil.rmtree(tmp_path / "town")

    with pytest.raises(FileNotFoundError, match=r"simulation\.json"):
        write(tmp_path / "town", routes=("00",), on_progress=remove)
