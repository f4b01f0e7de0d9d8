"""A drifted drive of known truth is corrected by its loops; wrong loops do not bend it; gtsam reads our g2o."""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from drives import drifted
from recordings import of_images
from scipy.spatial.transform import Rotation
from session_pairs import found_pair, two_drives

from sglpr_jax.data.mounting import Mounting, upright_from_lidar
from sglpr_jax.files import DataWarning
from sglpr_jax.loops.closure import LoopClosure, to_lidar
from sglpr_jax.loops.result import LoopSearchResult, Session
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.pose_graph.files import read_g2o, write_g2o
from sglpr_jax.pose_graph.optimize import (
    MAX_HEIGHT_CHANGE_M,
    OptimizedTrajectory,
    optimize_trajectory,
    placements,
    solve_pose_graph,
    trajectory_error,
)
from sglpr_jax.se3 import from_quaternions, inverse, transform

from .conftest import LAPS_FRAMES, LOOP_COVARIANCE


def optimized(odometry: np.ndarray, loops: Sequence[LoopClosure]) -> OptimizedTrajectory:
    return solve_pose_graph({0: odometry}, loops)


def test_the_error_of_a_drifted_drive_falls(two_laps, two_laps_odometry, second_lap_loops):
    true = two_laps[:, :3, 3]
    before = trajectory_error(two_laps_odometry, true)
    found = optimized(two_laps_odometry, second_lap_loops)
    assert found.inliers.all() and len(found.inliers) == len(second_lap_loops)
    assert before > 2 and trajectory_error(found.poses, true) < 0.4 * before
    np.testing.assert_allclose(found.poses[0], two_laps_odometry[0], atol=1e-6)
    for loop in second_lap_loops:
        error = inverse(inverse(found.poses[loop.match]) @ found.poses[loop.query]) @ loop.match_from_query
        assert np.linalg.norm(error[:3, 3]) < 1


def test_wrong_loops_do_not_bend_it(two_laps, two_laps_odometry, second_lap_loops):
    true = two_laps[:, :3, 3]
    wrong = tuple(LoopClosure(100 + k, 20 + k, transform(1.0, 0.0, 0.1), LOOP_COVARIANCE, 1.0) for k in range(3))
    found = optimized(two_laps_odometry, (*wrong, *second_lap_loops))
    assert not found.inliers[:3].any() and found.inliers[3:].all()
    assert trajectory_error(found.poses, true) == pytest.approx(
        trajectory_error(optimized(two_laps_odometry, second_lap_loops).poses, true), abs=0.05
    )


def test_exact_loops_are_used_although_they_bend_odometry_that_jitters(two_laps):
    """They are far more exact than the odometry between them, whose directions have errors of 0.3 degrees."""
    rng = np.random.default_rng(0)
    jitter = np.tile(np.eye(4), (LAPS_FRAMES, 1, 1))
    jitter[:, :3, :3] = Rotation.from_rotvec(np.radians(0.3) * rng.normal(size=(LAPS_FRAMES, 3))).as_matrix()
    covariance = np.diag([0.01, 0.01, 0.003, *np.radians([0.05, 0.03, 0.02])]) ** 2
    loops = []
    for query in range(64, LAPS_FRAMES, 2):
        match = int(np.linalg.norm(two_laps[:50, :3, 3] - two_laps[query, :3, 3], axis=1).argmin())
        pose = inverse(two_laps[match]) @ two_laps[query]
        loops.append(LoopClosure(query, match, pose, covariance, 0.99))
    assert optimized(two_laps @ jitter, loops).inliers.all()


def test_loops_at_which_a_solution_bends_are_dropped(two_laps_odometry, second_lap_loops, monkeypatch):
    solved_loops = []

    def solve(odometry, loops, sessions, drifts):
        """Keeps all loops at first, and puts the query of one of them 20 m aside."""
        poses = odometry.copy()
        if not solved_loops:
            poses[bent.query] = poses[bent.query] @ transform(0.0, 20.0, 0.0)
        solved_loops.append([loop.query for loop in loops])
        return poses, np.ones(len(loops), bool)

    monkeypatch.setattr("sglpr_jax.pose_graph.optimize._solve_with_gtsam", solve)
    bent, loops = second_lap_loops[6], second_lap_loops[::3]
    found = optimized(two_laps_odometry, loops)
    assert bent.query in solved_loops[0] and bent.query not in solved_loops[1] and solved_loops[1]
    queries = [loop.query for loop, is_inlier in zip(loops, found.inliers, strict=True) if is_inlier]
    assert queries == solved_loops[-1]


def test_of_a_recording_the_searched_frames_are_corrected(two_laps_odometry, second_lap_loops, tmp_path, monkeypatch):
    images = {tmp_path / f"{i:06d}.png": np.zeros((4, 4), np.float32) for i in range(LAPS_FRAMES)}
    early = tuple(loop for loop in second_lap_loops if loop.query < 90)
    session = Session(of_images(images), 90, two_laps_odometry)
    found = LoopSearchResult((session,), early)
    corrected = optimize_trajectory(found)
    assert corrected.poses.shape == (90, 4, 4)
    np.testing.assert_allclose(corrected.poses, optimized(two_laps_odometry[:90], early).poses, atol=1e-9)
    with pytest.raises(ValueError, match="08: expected loops found with odometry, found loops without it"):
        optimize_trajectory(LoopSearchResult((dataclasses.replace(session, odometry=None),), early))
    none = optimize_trajectory(LoopSearchResult((session,)))
    np.testing.assert_array_equal(none.poses, two_laps_odometry[:90])
    assert none.inliers.shape == (0,)
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(ImportError, match=r"gtsam: .* -m pip install .*gtsam"):
        optimize_trajectory(found)


def test_sessions_fit_together_better_than_by_one_transform():
    first, second, true = two_drives()
    odometry = drifted(first, percent=1, deg_per_100m=0.5), drifted(second, percent=-1, deg_per_100m=-0.5)
    found = found_pair(odometry=odometry)
    corrected = optimize_trajectory(found)
    assert corrected.inliers.all() and len(found.split(corrected.poses)[1]) == len(second)
    np.testing.assert_allclose(corrected.poses[0], odometry[0][0], atol=1e-5)
    truth = np.concatenate([first, true @ second])[:, :3, 3]
    (_, own), (group, placed) = placements(found)
    assert group == 0 and np.array_equal(own, np.eye(4))
    before = trajectory_error(np.concatenate([odometry[0], placed @ odometry[1]]), truth)
    assert trajectory_error(corrected.poses, truth) < 0.8 * before


@pytest.mark.parametrize("worse", [0, 1])
def test_loops_fit_the_drift_of_their_session_in_any_order(worse, two_laps, second_lap_loops):
    """The odometry of one recording drifts ten times as much as usual, as its search has found."""
    images = {Path(f"{i:06d}.png"): np.zeros((4, 4), np.float32) for i in range(LAPS_FRAMES)}
    drifting = drifted(two_laps, percent=0, deg_per_100m=5)
    sessions = [Session(of_images(images), 2, two_laps)] * 2
    sessions[worse] = Session(of_images(images), 90, drifting, drift=DriftModel().scaled(10.0))
    in_session = {"match_session": worse, "query_session": worse, "overlap": 0.9}
    loops = [dataclasses.replace(loop, **in_session) for loop in second_lap_loops if loop.query < 90]
    result = LoopSearchResult(tuple(sessions), tuple(loops), transforms=found_pair().transforms)
    assert not solve_pose_graph({worse: drifting}, loops).inliers.any()
    assert optimize_trajectory(result).inliers.all()


def test_the_trajectory_that_drifts_more_is_moved(two_laps):
    bent = drifted(two_laps, percent=0, deg_per_100m=5)
    loops = []
    for frame in range(0, LAPS_FRAMES, 8):
        nodes = {"match_session": 0, "query_session": 1}
        loops.append(LoopClosure(frame, frame, np.eye(4), LOOP_COVARIANCE, 0.99, overlap=0.9, **nodes))
    found = solve_pose_graph({0: two_laps, 1: bent}, loops, {0: DriftModel(), 1: DriftModel().scaled(10.0)})
    exact_moved_m, bent_moved_m = (
        np.linalg.norm(found.poses[:, :3, 3] - np.concatenate([two_laps, bent])[:, :3, 3], axis=1)
        .reshape(2, -1)
        .max(axis=1)
    )
    assert found.inliers.all() and exact_moved_m < 0.1 * bent_moved_m


def test_a_third_session_is_placed_through_the_second():
    pair = found_pair()
    (first,) = pair.transforms
    second = first._replace(match=first.match._replace(session=1), query=first.query._replace(session=2))
    step = first.match_from_query
    chain = dataclasses.replace(pair, sessions=(*pair.sessions, pair.sessions[1]), transforms=(first, second))
    np.testing.assert_allclose([to for _, to in placements(chain)], [np.eye(4), step, step @ step], atol=1e-9)
    around = second._replace(match=first.match)
    found = placements(dataclasses.replace(chain, transforms=(around, second)))
    assert [group for group, _ in found] == [0, 0, 0]
    np.testing.assert_allclose(found[1][1], step @ inverse(step), atol=1e-9)
    unused = first.query._replace(session=2, is_odometry=False)  # two parts of a session, each in its own frame
    parts = first._replace(query=unused), second._replace(query=unused)
    assert [group for group, _ in placements(dataclasses.replace(chain, transforms=parts))] == [0, 1, 2]


def test_gtsam_reads_the_graph_that_we_write(two_laps_odometry, second_lap_loops, tmp_path):
    import gtsam

    path = tmp_path / "loops.g2o"
    write_g2o(path, second_lap_loops, [(np.arange(LAPS_FRAMES), two_laps_odometry, DriftModel())])
    graph, start = gtsam.readG2o(str(path), True)
    assert start.size() == LAPS_FRAMES and graph.size() == LAPS_FRAMES - 1 + len(second_lap_loops)
    read = np.stack([start.atPose3(frame).matrix() for frame in range(LAPS_FRAMES)])
    np.testing.assert_allclose(read, two_laps_odometry, atol=1e-5)
    ours = read_g2o(path)
    for k, (first, second, pose, information) in enumerate(ours.edges):
        factor = graph.at(k)
        assert (first, second) == tuple(factor.keys())
        np.testing.assert_allclose(factor.measured().matrix(), pose, atol=1e-6)
        theirs = factor.noiseModel().information()  # rotation first
        order = np.array([3, 4, 5, 0, 1, 2])
        np.testing.assert_allclose(theirs, information[np.ix_(order, order)], rtol=1e-6, atol=1e-6)


def test_the_error_does_not_mind_where_a_trajectory_lies():
    rng = np.random.default_rng(0)
    true = rng.normal(scale=20, size=(50, 3))
    rotations = Rotation.random(50, rng=rng).as_quat()
    world = transform(5.0, -3.0, 2.0) @ from_quaternions(np.zeros((1, 3)), Rotation.random(rng=rng).as_quat()[None])[0]
    poses = world @ from_quaternions(true, rotations)
    assert trajectory_error(poses, true) == pytest.approx(0, abs=1e-9)
    noise = rng.normal(size=(50, 3))
    assert trajectory_error(from_quaternions(true + noise, rotations), true) == pytest.approx(np.sqrt(3), rel=0.15)


def test_heights_that_move_by_metres_are_told(two_laps, two_laps_odometry, second_lap_loops):
    images = {Path(f"{i:06d}.png"): np.zeros((4, 4), np.float32) for i in range(LAPS_FRAMES)}
    low = two_laps_odometry.copy()
    low[:, 2, 3] -= 0.06 * np.arange(LAPS_FRAMES)  # odometry that sinks, which loops of known heights correct
    moved = LoopSearchResult((Session(of_images(images), LAPS_FRAMES, low),), second_lap_loops)
    with pytest.warns(DataWarning, match="08: expected heights near those of the odometry, found them moved by"):
        corrected = optimize_trajectory(moved)
    assert np.abs(corrected.poses[:, 2, 3] - low[:, 2, 3]).max() > MAX_HEIGHT_CHANGE_M
    registered = [dataclasses.replace(loop, overlap=0.9) for loop in second_lap_loops]
    optimize_trajectory(dataclasses.replace(moved, loops=tuple(registered)))  # without a warning


def test_horizontal_corrections_of_a_tilted_sensor_are_no_changes_of_height(two_laps_odometry, second_lap_loops):
    """The z axis of the first LiDAR frame points half forwards."""
    mounting = Mounting(1.73, (-np.sqrt(0.5), 0.0, np.sqrt(0.5)))
    images = {Path(f"{i:06d}.png"): np.zeros((4, 4), np.float32) for i in range(LAPS_FRAMES)}
    lidar = two_laps_odometry @ upright_from_lidar(mounting)
    odometry = inverse(lidar[0]) @ lidar
    loops = [to_lidar(loop, query=mounting, match=mounting) for loop in second_lap_loops if loop.query < 90]
    session = Session(of_images(images, mounting=mounting), 90, odometry)
    corrected = optimize_trajectory(LoopSearchResult((session,), tuple(loops)))  # without a warning
    assert np.abs(corrected.poses - odometry[:90])[:, 2, 3].max() > MAX_HEIGHT_CHANGE_M
