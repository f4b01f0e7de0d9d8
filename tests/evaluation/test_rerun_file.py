"""The file for the rerun viewer has trajectories, scans, a line and images for each loop, and probabilities."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np

from sglpr_jax.evaluation.rerun_file import write_rerun
from sglpr_jax.loops.search import find_loops
from sglpr_jax.models.weights_file import load
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory
from sglpr_jax.se3 import transform
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import Sensor

SMALL = Sensor(elevations_deg=(2.0, -2.0, -6.0, -12.0), azimuth_steps=90)


def entities(path: Path) -> set[str]:
    """Return the entities of a file, as listed by the command of rerun."""
    command = [sys.executable, "-m", "rerun", "rrd", "print", str(path)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    return {word for line in run.stdout.splitlines() for word in line.replace("`", " ").split() if word.startswith("/")}


def test_the_file_has_both_trajectories_and_each_loop(found_loops, tmp_path):
    moved = found_loops.sessions[0].odometry @ transform(0.1, 0.0, 0.0)
    write_rerun(found_loops, tmp_path / "a.rrd", optimized=OptimizedTrajectory(moved, np.ones(3, bool)))
    there = entities(tmp_path / "a.rrd")
    expected = {"/map/trajectory/given", "/map/trajectory/corrected", "/map/sensor", "/map/loops/5", "/map/loops/6"}
    assert expected | {"/pair", "/evidence/loop"} <= there


def test_a_file_without_poses_has_the_images(found_loops, tmp_path):
    bare = dataclasses.replace(found_loops.sessions[0], odometry=None)
    write_rerun(dataclasses.replace(found_loops, sessions=(bare,)), tmp_path / "a.rrd")
    there = entities(tmp_path / "a.rrd")
    assert "/pair" in there and not any(name.startswith("/map") for name in there)


def test_the_file_has_scans_and_probabilities(tmp_path):
    drive = simulate_recording("08", scans=12, seed=3, sensor=SMALL)
    found = find_loops(drive, load("sglpr-small"), odometry=drive.poses.world_from_lidar, registered=False)
    write_rerun(found, tmp_path / "a.rrd")
    scans = {name for name in entities(tmp_path / "a.rrd") if name.startswith("/map/scans/")}
    assert "/map/scans/0" in scans and len(scans) >= 3
