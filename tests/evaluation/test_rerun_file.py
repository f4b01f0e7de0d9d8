"""The file for the rerun viewer holds the trajectory, a line for each loop, its images, and the evidence."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recordings import of_images

from sglpr_jax.evaluation import rerun_file
from sglpr_jax.evaluation.rerun_file import write_rerun
from sglpr_jax.loops.closure import Loop
from sglpr_jax.loops.result import FoundLoops, Session
from sglpr_jax.loops.search import find_loops
from sglpr_jax.models.weights_file import load
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory
from sglpr_jax.se3 import transform
from sglpr_jax.sim.recording import simulate_recording


def entities(path: Path) -> set[str]:
    """Entities of a file, as the program of rerun lists them."""
    command = [sys.executable, "-m", "rerun", "rrd", "print", str(path)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    return {word for line in run.stdout.splitlines() for word in line.replace("`", " ").split() if word.startswith("/")}


@pytest.fixture
def found(tmp_path) -> FoundLoops:
    rng = np.random.default_rng(0)
    images = {tmp_path / f"{i:06d}.png": rng.uniform(0, 10, (20, 20)).astype(np.float32) for i in range(8)}
    odometry = np.stack([transform(float(x), 0.0, 0.0) for x in range(8)])
    loops = tuple(Loop(q, q - 4, transform(1.0, 2.0, 0.3), np.eye(6), 0.99 + q / 1000) for q in (5, 6))
    return FoundLoops((Session(of_images(images, times=np.arange(8.0)), 8, odometry),), loops)


def test_both_trajectories_and_each_loop_are_there(found, tmp_path):
    corrected = OptimizedTrajectory(found.sessions[0].odometry @ transform(0.1, 0.0, 0.0), np.ones(2, bool))
    write_rerun(found, tmp_path / "a.rrd", optimized=corrected)
    there = entities(tmp_path / "a.rrd")
    expected = {"/map/trajectory/given", "/map/trajectory/corrected", "/map/sensor", "/map/loops/5", "/map/loops/6"}
    assert expected | {"/pair", "/evidence/loop"} <= there


def test_without_poses_the_images_remain(found, tmp_path):
    bare = dataclasses.replace(found.sessions[0], odometry=None)
    write_rerun(dataclasses.replace(found, sessions=(bare,)), tmp_path / "a.rrd")
    there = entities(tmp_path / "a.rrd")
    assert "/pair" in there and not any(name.startswith("/map") for name in there)


def test_scans_of_keyframes_and_the_evidence(tmp_path):
    drive = simulate_recording("08", scans=12, seed=3)
    found = find_loops(drive, load("circular"), odometry=drive.poses.world_from_lidar, registered=False)
    write_rerun(found, tmp_path / "a.rrd")
    scans = {name for name in entities(tmp_path / "a.rrd") if name.startswith("/map/scans/")}
    assert "/map/scans/0" in scans and len(scans) >= 3


def test_an_existing_file_is_replaced_whole_or_not_at_all(found, tmp_path, monkeypatch):
    path = tmp_path / "a.rrd"
    path.write_text("before")
    monkeypatch.setattr(rerun_file, "_log_loops", lambda *args: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_rerun(found, path)
    assert path.read_text() == "before" and list(tmp_path.glob("*.tmp")) == []
