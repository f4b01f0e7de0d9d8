"""Commands compute odometry from the scans."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from drives import simulated_drive
from recordings import of_scans

from sglpr_jax.cli.loops import LoopsCommand
from sglpr_jax.cli.recording import AUTO, RecordingOptions, open_with_odometry
from sglpr_jax.data.formats.pose_files import read_tum
from sglpr_jax.data.scan import Scan, TimeField
from sglpr_jax.extras import install_command
from sglpr_jax.odometry import kiss_icp

from .conftest import assert_one_line_error

SCANS = 8


@pytest.fixture(scope="module")
def street(once):
    """A folder of scans of a street."""

    def make(folder):
        folder.mkdir()
        recording = simulated_drive()
        for row in range(SCANS):
            recording.render(row)[0].astype("<f4").tofile(folder / f"{row:06d}.bin")
        np.savetxt(folder / "times.txt", recording.times[:SCANS])

    return once("street", make)


@pytest.fixture
def run(street):
    """Arguments of a command on the street."""
    return (street, "--format", "kitti", "--sensor-height", "1.73")


@pytest.mark.slow
def test_loops_of_scans_alone_end_with_a_trajectory(command, run, tmp_path):
    out = tmp_path / "found"
    flags = ("--odometry", "auto", "--optimize", "--scan-odometry.max-range-m", "80", "--out", out)
    ended = command("loops", *run, *flags)
    assert ended.status == 0, ended.error
    assert "points up to 80 m, voxels of 0.8 m, motion within scans not removed: no valid times of " in ended.error
    poses = read_tum(out / "trajectory.tum")[0]
    np.testing.assert_allclose(read_tum(out / "trajectory-optimized.tum")[0], poses, atol=1e-6)
    assert poses.shape == (SCANS, 4, 4) and np.linalg.norm(poses[-1, :3, 3]) > 10
    values = json.loads((out / "command.json").read_text())
    assert (values["odometry"], values["scan-odometry.voxel-m"]) == ("auto", 0.8)
    assert not [path for path in out.iterdir() if path.name.startswith("unfinished")]


@pytest.mark.slow
def test_a_map_of_scans_alone(command, run, tmp_path):
    ended = command("map", *run, "--poses", "auto", "--out", tmp_path / "street.safetensors")
    assert ended.status == 0, ended.error
    assert read_tum(tmp_path / "street.odometry.tum")[0].shape == (SCANS, 4, 4)
    assert {path.name for path in tmp_path.iterdir()} == {"street.safetensors", "street.odometry.tum"}


def test_an_interrupted_run_keeps_its_odometry(command, run, tmp_path, monkeypatch):
    out, compute = tmp_path / "found", kiss_icp.scan_odometry

    def stopped(recording, *, should_stop, on_progress, **options):
        def count(done):
            should_stop.signal = 2 if done == 3 else None

        return compute(recording, should_stop=should_stop, on_progress=count, **options)

    monkeypatch.setattr(kiss_icp, "scan_odometry", stopped)
    ended = command("loops", *run, "--odometry", "auto", "--out", out)
    assert ended.status == 130
    assert f"odometry of 3 of {SCANS} scans; run the same command again to continue\n" in ended.out
    assert [path.name for path in out.rglob("*")] == ["unfinished", "0", "odometry.log"]


def test_each_recording_is_deskewed_if_it_has_times_of_points(monkeypatch):
    cloud = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    scan = Scan(points=cloud, time_field=TimeField("t", np.linspace(0, 0.1, 9)))
    plain = of_scans({Path(f"{row}.bin"): cloud for row in range(3)}, times=0.1 * np.arange(3))
    named = {Path("timed"): dataclasses.replace(plain, read=lambda *_: scan), Path("plain"): plain}
    monkeypatch.setattr(RecordingOptions, "open", lambda self, path: named[path])
    monkeypatch.setattr(kiss_icp, "scan_odometry", lambda recording, **_: np.tile(np.eye(4), (len(recording), 1, 1)))
    options = {"format": "auto", "checkpoint": lambda number: Path("kept.log")}
    command, (timed, untimed), _ = open_with_odometry(LoopsCommand(tuple(named)), tuple(named), AUTO, **options)
    assert "deskewed" in timed.found[-1] and untimed is plain and not command.submap.deskew


def test_images_and_a_missing_library_are_one_clear_error(command, images, run, tmp_path, monkeypatch):
    flags = ("--odometry", "auto", "--out", tmp_path / "found")
    ended = command("loops", images, "--seq", "06", *flags)
    assert_one_line_error(ended, "06: expected scans for odometry, found ready-made images")
    monkeypatch.setitem(sys.modules, "kiss_icp.kiss_icp", None)
    for given in (("loops", *run, *flags), ("map", *run, "--poses", "auto", "--out", tmp_path / "map.safetensors")):
        assert_one_line_error(command(*given), f"needs kiss-icp: {install_command('odometry')}")
    assert not list(tmp_path.iterdir())
