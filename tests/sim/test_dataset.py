"""The KITTI layout on disk: readable with plain numpy, the same bytes for the same seed, resumable."""

import json
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.poses import positions_from_camera
from sglpr_jax.sim import Sensor, build_world, plan_drive, write_dataset
from sglpr_jax.sim.drive import streets_needed

TINY = Sensor(elevations_deg=(2.0, -2.0, -6.0, -10.0, -14.0, -18.0, -21.0, -24.0), azimuth_steps=60)
SCANS = 4


def write(root: Path, **changes) -> Path:
    return write_dataset(root, **({"names": ("00", "08"), "scans": SCANS, "sensor": TINY, "seed": 1} | changes))


def content(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("town") / "data")


def test_layout(dataset):
    for name in ("00", "08"):
        folder = dataset / "sequences" / name
        stems = [path.stem for path in sorted((folder / "velodyne").iterdir())]
        assert stems == [path.stem for path in sorted((folder / "labels").iterdir())] == [f"{i:06d}" for i in range(4)]
        for stem in stems:
            points = np.fromfile(folder / "velodyne" / f"{stem}.bin", "<f4").reshape(-1, 4)
            labels = np.fromfile(folder / "labels" / f"{stem}.label", "<u4")
            assert 300 < len(points) == len(labels) <= 480
            assert np.all(np.isfinite(points)) and labels.max() <= 259 and (labels > 0).all()
    assert json.loads((dataset / "simulation.json").read_text())["seed"] == 1


def test_poses_times_and_calibration_are_kittis(dataset):
    folder = dataset / "sequences" / "08"
    poses = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    world = build_world((1, 8), streets=streets_needed("08", SCANS))
    drive = plan_drive(np.random.default_rng((1, 8, 1)), "08", world, scans=SCANS, height_m=TINY.height_m)
    np.testing.assert_allclose(positions_from_camera(poses), drive.world_from_lidar[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(np.loadtxt(folder / "times.txt"), drive.times, rtol=1e-5)
    rows = dict(line.split(":") for line in (folder / "calib.txt").read_text().splitlines())
    camera_from_lidar = np.array(rows["Tr"].split(), float).reshape(3, 4)
    np.testing.assert_array_equal(camera_from_lidar, [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
    # KITTI's camera looks along z: where x of the LiDAR points.
    rotation = camera_from_lidar[:, :3]
    expected = rotation @ drive.world_from_lidar[:, :3, 0, None]
    np.testing.assert_allclose(poses[:, :, 2:3], expected, atol=1e-6)


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(dataset, tmp_path):
    again = content(write(tmp_path / "again"))
    assert again == content(dataset)
    other = content(write(tmp_path / "other", seed=2))
    assert (
        other.keys() == again.keys()
        and other["sequences/00/velodyne/000000.bin"] != again["sequences/00/velodyne/000000.bin"]
    )


def test_drives_do_not_depend_on_each_other(dataset, tmp_path):
    alone = content(write(tmp_path / "alone", names=("08",)))
    everything = content(dataset)
    assert {name: data for name, data in everything.items() if "/00/" not in name} == alone


def test_an_interrupted_run_is_recognised_and_resumed(dataset, tmp_path):
    calls = []

    def interrupt(name: str, done: int, scans: int) -> None:
        calls.append((name, done, scans))
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "cut", progress=interrupt)
    assert calls == [("00", 1, SCANS), ("00", 2, SCANS)]
    assert not (tmp_path / "cut" / "sequences" / "00" / "poses.txt").exists()
    assert content(write(tmp_path / "cut")) == content(dataset)


def test_deleted_scans_come_back_and_finished_ones_are_left_alone(dataset, tmp_path):
    root = write(tmp_path / "kept")
    scans = root / "sequences" / "00" / "velodyne"
    (scans / "000001.bin").unlink()
    (root / "sequences" / "00" / "labels" / "000002.label").unlink()
    kept = (scans / "000000.bin").stat().st_mtime_ns
    assert content(write(root)) == content(dataset)
    assert (scans / "000000.bin").stat().st_mtime_ns == kept


@pytest.mark.parametrize(
    ("changes", "found"),
    [({"seed": 2}, r"seed 2 \(found 1\)"), ({"scans": 5}, "scans 5"), ({"sensor": Sensor()}, "sensor")],
)
def test_other_settings_are_refused(dataset, changes, found):
    before = content(dataset)
    with pytest.raises(ValueError, match=f"simulation.json belongs to another.*{found}"):
        write(dataset, **changes)
    assert content(dataset) == before


def test_real_sequences_are_never_written_into(tmp_path):
    (tmp_path / "sequences" / "00").mkdir(parents=True)
    with pytest.raises(ValueError, match="not simulated"):
        write(tmp_path)
    assert content(tmp_path) == {}


@pytest.mark.parametrize("changes", [{"names": ("00", "03")}, {"scans": 1}])
def test_unknown_drives_and_too_few_scans_are_refused(tmp_path, changes):
    with pytest.raises(ValueError, match="expected drives among 00, 05, 08"):
        write(tmp_path / "none", **changes)
    assert not (tmp_path / "none").exists()
