"""The file for the rerun viewer has trajectories, scans, a line and images for each loop, and probabilities."""

import dataclasses

import numpy as np
from recordings import entities, with_points

from sglpr_jax.evaluation.rerun_file import write_rerun
from sglpr_jax.loops.search import find_loops
from sglpr_jax.models.weights_file import load
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory
from sglpr_jax.se3 import transform
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import Sensor

SMALL = Sensor(elevations_deg=(2.0, -2.0, -6.0, -12.0), azimuth_steps=90)


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


def test_the_file_has_readable_scans_and_probabilities(tmp_path):
    drive = simulate_recording("08", scans=12, seed=3, sensor=SMALL)
    found = find_loops(drive, load("sglpr-small"), odometry=drive.poses.world_from_lidar, registered=False)

    def points_of(path):
        if path == drive.paths[0]:
            raise ValueError("expected a whole scan, found half of one")
        return drive.read(path, None).points

    session = dataclasses.replace(found.sessions[0], recording=with_points(drive, points_of))
    write_rerun(dataclasses.replace(found, sessions=(session,)), tmp_path / "a.rrd")
    scans = {name for name in entities(tmp_path / "a.rrd") if name.startswith("/map/scans/")}
    assert "/map/scans/0" not in scans and len(scans) >= 3
