"""Simulated drives on disk and on the fly: layouts, the same bytes for the same seed, resumable, whole or not there."""

import dataclasses
import json
import resource
import shutil
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.data.density_image import density_bev, density_image, density_label_image
from sglpr_jax.data.mounting import MODEL_HEIGHT_M
from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.sampling.batch import read_batch
from sglpr_jax.data.sampling.config import TupleConfig
from sglpr_jax.data.sampling.tuples import TuplePool
from sglpr_jax.labels import to_classes
from sglpr_jax.se3 import positions_from_camera
from sglpr_jax.sim import recording
from sglpr_jax.sim.dataset import write_dataset, write_sessions
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.scenery import OUTSKIRTS
from sglpr_jax.sim.sensor import SENSORS, Sensor, scan
from sglpr_jax.sim.sessions import plan_sessions

TINY = Sensor(elevations_deg=(2.0, -2.0, -6.0, -10.0, -14.0, -18.0, -21.0, -24.0), azimuth_steps=60)
SCANS = 4


def write(root: Path, **changes) -> Path:
    return write_dataset(root, **({"names": ("00", "08"), "scans": SCANS, "sensor": TINY, "seed": 1} | changes))


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


def test_layout(dataset):
    for name in ("00", "08"):
        folder = dataset / "sequences" / name
        stems = [path.stem for path in sorted((folder / "velodyne").iterdir())]
        assert stems == [path.stem for path in sorted((folder / "labels").iterdir())] == [f"{i:06d}" for i in range(4)]
        for stem in stems:
            points = np.fromfile(folder / "velodyne" / f"{stem}.bin", "<f4").reshape(-1, 4)
            labels = np.fromfile(folder / "labels" / f"{stem}.label", "<u4")
            assert 200 < len(points) == len(labels) <= 480
            assert np.all(np.isfinite(points)) and labels.max() <= 259 and (labels > 0).all()
    assert json.loads((dataset / "simulation.json").read_text())["seed"] == 1


def test_poses_times_and_calibration_are_kittis(dataset, drive):
    folder = dataset / "sequences" / "08"
    poses = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(positions_from_camera(poses), drive.positions, atol=1e-5)
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
    assert drive.ids == on_disk.ids and len(drive) == SCANS and drive.name == "08"
    for i in range(SCANS):
        np.testing.assert_array_equal(drive.points(i), on_disk.points(i))
        np.testing.assert_array_equal(drive.labels(i), on_disk.labels(i))


@pytest.mark.slow
def test_images_are_as_of_a_sensor_at_the_height_that_models_know(tmp_path):
    low = dataclasses.replace(TINY, height_m=0.8)
    image = open_recording(write(tmp_path, names=("08",), sensor=low, layout="images"), "08").image(0)
    drive = simulate_recording("08", scans=SCANS, sensor=low, seed=1)
    np.testing.assert_array_equal(image, density_bev(drive.points(0) + np.float32([0, 0, 0.8 - MODEL_HEIGHT_M])))
    assert image.sum() < density_bev(drive.points(0)).sum()  # there with all of the road


def test_points_and_labels_of_a_scan_cost_one_rendering(monkeypatch):
    rendered = []
    monkeypatch.setattr(recording, "scan", lambda *a, **k: rendered.append(k["time"]) or scan(*a, **k))
    fresh = simulate_recording("08", scans=SCANS, sensor=TINY, seed=2)
    assert len(fresh.points(1)) == len(fresh.labels(1)) and len(fresh.points(2)) == len(fresh.labels(2))
    assert rendered == [fresh.times[1], fresh.times[2]]


def test_training_batches_are_read_from_a_drive_on_the_fly(drive):
    pool = TuplePool([drive.positions], TupleConfig(positives=1, negatives=1, positive_m=1e6, negative_m=1.0))
    batch = read_batch([drive], pool, np.array([[0, 1, 2]]), max_points=480, share_negatives=False)
    assert batch.labelled.all() and batch.points.shape == (3, 480, 3)
    np.testing.assert_array_equal(batch.classes[1, : batch.count[1]], to_classes(drive.labels(1)))


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_and_another_does_not(dataset, tmp_path):
    again = content(write(tmp_path / "again"))
    assert again == content(dataset)
    other = content(write(tmp_path / "other", seed=2))
    first = "sequences/00/velodyne/000000.bin"
    assert other.keys() == again.keys() and other[first] != again[first]


@pytest.mark.slow
def test_drives_can_be_added_and_do_not_depend_on_each_other(dataset, tmp_path):
    root = write(tmp_path / "grown", names=("08",))
    kept = (root / "sequences" / "08" / "velodyne" / "000000.bin").stat().st_mtime_ns
    assert content(write(root, names=("00",))) == content(dataset)
    assert (root / "sequences" / "08" / "velodyne" / "000000.bin").stat().st_mtime_ns == kept


@pytest.mark.slow
def test_an_interrupted_run_is_recognised_and_resumed(dataset, tmp_path):
    calls = []

    def interrupt(name: str, done: int, scans: int) -> None:
        calls.append((name, done, scans))
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "cut", progress=interrupt)
    assert calls == [("00", 0, SCANS), ("00", 1, SCANS), ("00", 2, SCANS)]
    assert not (tmp_path / "cut" / "sequences" / "00" / "poses.txt").exists()
    assert content(write(tmp_path / "cut")) == content(dataset)


@pytest.mark.slow
def test_deleted_scans_come_back_and_finished_ones_are_left_alone(dataset, tmp_path):
    root = write(tmp_path / "kept")
    scans = root / "sequences" / "00" / "velodyne"
    (scans / "000001.bin").unlink()
    (root / "sequences" / "00" / "labels" / "000002.label").unlink()
    kept = (scans / "000000.bin").stat().st_mtime_ns
    assert content(write(root)) == content(dataset)
    assert (scans / "000000.bin").stat().st_mtime_ns == kept


def test_a_finished_dataset_builds_no_town(dataset, monkeypatch):
    monkeypatch.setattr(recording, "build_world", None)
    before = content(dataset)
    assert content(write(dataset)) == before


def test_along_a_pose_file_distances_are_the_files(tmp_path, pose_file):
    root = write(tmp_path / "along", names=(), along=(pose_file,), scans=8)
    drive = open_recording(root, "campus")
    assert len(drive) == 8  # every 19th of 150
    np.testing.assert_allclose(drive.positions[:, 0], 9.5 * np.arange(8), atol=1e-6)
    np.testing.assert_allclose(drive.positions[:, 1], 0, atol=1e-6)
    np.testing.assert_allclose(drive.times, 1.9 * np.arange(8), atol=1e-6)
    on_the_fly = simulate_recording(along=pose_file, scans=8, sensor=TINY, seed=1)
    np.testing.assert_array_equal(on_the_fly.points(3), drive.points(3))


def test_another_pose_file_of_that_name_is_refused(tmp_path, pose_file):
    root = write(tmp_path / "along", names=(), along=(pose_file,), scans=8)
    before = content(root)
    poses = np.loadtxt(pose_file)
    poses[:, 3::4] *= 1.1
    np.savetxt(pose_file, poses)
    with pytest.raises(ValueError, match=r"simulation.json belongs to another.*drive campus"):
        write(root, names=(), along=(pose_file,), scans=8)
    assert content(root) == before


def test_a_malformed_pose_file_leaves_nothing_behind(tmp_path, pose_file):
    pose_file.write_text(pose_file.read_text().replace("5.000000000000000000e-01", "nan"))
    with pytest.raises(ValueError, match=r"campus.txt, line 2: expected finite numbers, found .*nan"):
        write(tmp_path / "along", names=(), along=(pose_file,))
    assert not (tmp_path / "along").exists()


def test_images_are_those_of_the_scans(tmp_path, drive):
    root = write(tmp_path / "images", names=("08",), layout="images")
    pictures = [f"08/{what}/{i:06d}.png" for what in ("imgs", "labels") for i in range(SCANS)]
    assert sorted(content(root)) == [*pictures, "08/pose.txt", "simulation.json"]
    images = open_recording(root, "08")
    assert images.has_images
    np.testing.assert_allclose(images.positions, drive.positions, atol=1e-5)
    expected = np.rot90(density_image(drive.points(2)), -1) * np.float32(10 / 255)
    np.testing.assert_array_equal(images.image(2), expected)
    assert expected.max() > 0
    labels = images.labels(2)
    shown = np.rot90(density_label_image(drive.points(2), drive.labels(2)), -1)
    np.testing.assert_array_equal(labels, np.where(expected > 0, shown, 0))
    assert 0.8 < (labels[expected > 0] > 0).mean() <= 1


@pytest.mark.slow
def test_images_written_before_there_were_label_maps_get_them(tmp_path):
    root = write(tmp_path / "images", names=("08",), layout="images")
    whole = content(root)
    shutil.rmtree(root / "08" / "labels")
    assert content(write(root, names=("08",), layout="images")) == whole


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"seed": 2}, r"seed 2 \(found 1\)"),
        ({"scans": 5}, "scans 5"),
        ({"sensor": SENSORS["vlp16"]}, "sensor"),
        ({"layout": "images"}, r"layout images \(found scans\)"),
        ({"rate_hz": 10.0}, "rate_hz 10"),
        ({"scenery": OUTSKIRTS}, "scenery .*walled"),
    ],
)
def test_other_settings_are_refused(dataset, changes, found):
    before = content(dataset)
    with pytest.raises(ValueError, match=f"simulation.json belongs to another.*{found}"):
        write(dataset, **changes)
    assert content(dataset) == before


def test_a_dataset_of_before_there_were_sceneries_is_a_town(dataset, tmp_path):
    old = shutil.copytree(dataset, tmp_path / "old")
    settings = json.loads((old / "simulation.json").read_text())
    del settings["scenery"]
    (old / "simulation.json").write_text(json.dumps(settings))
    write(old)
    with pytest.raises(ValueError, match=r"scenery .*walled"):
        write(old, scenery=OUTSKIRTS)


@pytest.mark.slow
def test_a_dataset_that_notes_older_names_of_a_scenery_is_completed(tmp_path):
    new = write(tmp_path / "new", names=("00",), scenery=OUTSKIRTS)
    old = shutil.copytree(new, tmp_path / "old")
    settings = json.loads((old / "simulation.json").read_text())
    for name in ("crossing_every", "wavelength"):
        settings["scenery"][name] = settings["scenery"].pop(f"{name}_m")
    (old / "simulation.json").write_text(json.dumps(settings))
    poses = "sequences/00/poses.txt"
    (old / poses).unlink()
    write(old, names=("00",), scenery=OUTSKIRTS)
    assert content(old)[poses] == content(new)[poses]
    with pytest.raises(ValueError, match="another simulated dataset"):
        write(old)


def test_files_that_were_not_simulated_are_never_written_among(tmp_path):
    (tmp_path / "sequences" / "00").mkdir(parents=True)
    with pytest.raises(ValueError, match="not simulated"):
        write(tmp_path)
    assert content(tmp_path) == {}


def test_damaged_settings_are_named(tmp_path):
    (tmp_path / "simulation.json").write_text('{"seed": 1')
    with pytest.raises(ValueError, match=r"simulation.json: expected JSON"):
        write(tmp_path)


@pytest.mark.parametrize("changes", [{"names": ("00", "11")}, {"scans": 1}])
def test_unknown_drives_and_too_few_scans_are_refused(tmp_path, changes):
    with pytest.raises(ValueError, match=r"expected drives among 00, 01, .* 10 with 2 scans"):
        write(tmp_path / "none", **changes)
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"rate_hz": 0.0}, "rate_hz: expected scans per second, more than 0, found 0.0"),
        ({"rate_hz": -4.0}, "rate_hz: .*found -4.0"),
        ({"rate_hz": float("nan")}, "rate_hz: .*found nan"),
        ({"rate_hz": float("inf")}, "rate_hz: .*found inf"),
        ({"seed": -1}, "seed: expected a whole number, 0 or more, found -1"),
    ],
)
def test_a_strange_rate_or_seed_is_refused_before_anything_is_written(tmp_path, changes, said):
    with pytest.raises(ValueError, match=said):
        write(tmp_path / "none", **changes)
    with pytest.raises(ValueError, match=said):
        write_sessions(tmp_path / "none", dates=("2012-01-15",), scans=SCANS, sensor=TINY, **changes)
    with pytest.raises(ValueError, match=said):
        simulate_recording("08", scans=SCANS, sensor=TINY, **changes)
    with pytest.raises(ValueError, match=said):
        plan_sessions(("2012-01-15",), scans=SCANS, sensor=TINY, **changes)
    assert not (tmp_path / "none").exists()


def test_two_drives_of_one_name_are_refused(tmp_path, pose_file):
    with pytest.raises(ValueError, match="expected different names"):
        write(tmp_path / "none", names=(), along=(pose_file, pose_file))
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_a_full_disk_is_one_clear_error_and_leaves_only_whole_files(dataset, tmp_path):
    """The limit on the size of a file stands in for the disk: writing fails half-way."""
    root = tmp_path / "full"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, before[1]))
    try:
        with pytest.raises(OSError, match=r"velodyne/00000\d.bin: cannot be written"):
            write(root)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    whole = content(dataset)
    assert all(whole[name] == data for name, data in content(root).items())
    assert content(write(root)) == whole


def test_a_folder_that_cannot_be_made_is_one_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"simulation.json: cannot be written"):
        write(tmp_path / "file" / "town")
