"""What the pages' examples find in their folder: scans, a dataset, a descriptor file."""

import shutil
from pathlib import Path

import pytest

import sglpr_jax
from sglpr_jax.methods.registry import method_named
from sglpr_jax.pose_graph.files import write_tum
from sglpr_jax.sim.dataset import simulate
from sglpr_jax.sim.sensor import Sensor

SENSOR = Sensor(elevations_deg=(2.0, -2.0, -6.0, -10.0, -14.0, -18.0, -21.0, -24.0), azimuth_steps=60)


@pytest.fixture(scope="session")
def examples(once) -> Path:
    """KITTI/ (three recordings of 105 thin scans, about 4 m apart), my_scans/ (five of them), 08.npz, odometry.tum."""
    return once("examples", write_examples)


def write_examples(folder: Path) -> None:
    simulate(folder / "KITTI", scans=105, sensor=SENSOR)
    (folder / "my_scans").mkdir()
    for scan in sorted((folder / "KITTI/sequences/08/velodyne").glob("*.bin"))[:5]:
        shutil.copy(scan, folder / "my_scans")
    recording = sglpr_jax.open_recording(folder / "KITTI", "08")
    sglpr_jax.embed(method_named("polar-fft"), recording).save(folder / "08.npz")
    poses = sglpr_jax.read_odometry(folder / "KITTI/sequences/08/poses.txt", format="kitti")
    write_tum(folder / "odometry.tum", poses, recording.times)


@pytest.fixture
def in_examples(examples, tmp_path, monkeypatch) -> Path:
    """A copy of these as the current folder."""
    folder = tmp_path / "examples"
    shutil.copytree(examples, folder)
    monkeypatch.chdir(folder)
    return folder
