"""The file for the rerun viewer has trajectories, scans, a line and images for each loop, and probabilities."""

import dataclasses
from pathlib import Path

import numpy as np
from recordings import entities, of_scans, with_points

from sglpr_jax.evaluation.rerun_file import write_rerun
from sglpr_jax.loops.comparison import Candidate
from sglpr_jax.loops.probability import Evidence, default_model
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.se3 import transform


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


def test_the_file_has_readable_scans_and_probabilities(found_loops, tmp_path):
    clouds = {Path(f"{i}.bin"): np.random.default_rng(i).uniform(-9, 9, (300, 3)).astype(np.float32) for i in range(8)}

    def points_of(path):
        if path.stem == "0":
            raise ValueError("expected a whole scan, found half of one")
        return clouds[path]

    pair = Candidate(5, 1, BevRegistration(1.0, 2.0, 0.3, np.eye(3), 0.8, 0.3), Evidence.of(0.5, 0.1, 1.0, 3.0))
    recording = with_points(of_scans(clouds, times=np.arange(8.0)), points_of)
    session = dataclasses.replace(found_loops.sessions[0], recording=recording, candidates=(pair,))
    write_rerun(dataclasses.replace(found_loops, sessions=(session,), model=default_model()), tmp_path / "a.rrd")
    there = entities(tmp_path / "a.rrd")
    assert {name for name in there if name.startswith("/map/scans/")} == {"/map/scans/5"}
    assert {"/evidence/probability", "/evidence/correlation"} <= there
