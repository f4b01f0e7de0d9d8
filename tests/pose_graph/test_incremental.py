"""A drifted drive is corrected while it goes on; wrong loops barely bend it; an unknown motion waits for a loop."""

import numpy as np
import pytest

from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.pose_graph import incremental
from sglpr_jax.pose_graph.incremental import LOOP_EVERY, NODE_EVERY_M, IncrementalTrajectory
from sglpr_jax.pose_graph.optimize import solve_pose_graph, trajectory_error
from sglpr_jax.se3 import inverse, transform

from .conftest import LOOP_COVARIANCE

ELSEWHERE = transform(300.0, -40.0, 2.0)
"""World of an odometry that began anew, in the world before."""


def driven(odometry, loops, *, new_world_at: int | None = None) -> IncrementalTrajectory:
    """Add all frames, each with the loops whose query it is."""
    trajectory = IncrementalTrajectory()
    for frame, pose in enumerate(odometry):
        found = [loop for loop in loops if loop.query == frame]
        moved = new_world_at is not None and frame >= new_world_at
        pose = inverse(ELSEWHERE) @ pose if moved else pose
        trajectory.add(pose, found, continues=frame != new_world_at)
    return trajectory


def test_loops_correct_the_last_pose_and_the_path(two_laps, two_laps_odometry, second_lap_loops):
    trajectory = driven(two_laps_odometry, second_lap_loops)
    batch = solve_pose_graph({0: two_laps_odometry}, second_lap_loops).poses
    np.testing.assert_allclose(trajectory.poses[:, :3, 3], batch[:, :3, 3], atol=0.5)
    true = two_laps[:, :3, 3]
    assert trajectory_error(trajectory.poses, true) < 0.4 * trajectory_error(two_laps_odometry, true)
    corrected = trajectory.map_from_world @ two_laps_odometry[-1]
    np.testing.assert_allclose(corrected, trajectory.poses[-1], atol=1e-9)


def test_a_wrong_loop_moves_little(two_laps, two_laps_odometry, second_lap_loops):
    wrong = LoopClosure(102, 20, transform(1.0, 0.0, 0.1), LOOP_COVARIANCE, 1.0)
    right = driven(two_laps_odometry, second_lap_loops).poses
    bent = driven(two_laps_odometry, (*second_lap_loops, wrong)).poses
    assert np.linalg.norm(bent[:, :3, 3] - right[:, :3, 3], axis=1).max() < 0.5
    trusted = LoopClosure(102, 20, wrong.match_from_query, LOOP_COVARIANCE / 1e4, 1.0)
    assert np.linalg.norm(driven(two_laps_odometry, (trusted,)).poses[102, :3, 3] - two_laps[102, :3, 3]) > 3


def test_a_new_odometry_frame_waits_for_a_loop(two_laps, two_laps_odometry, second_lap_loops):
    first = second_lap_loops[0].query
    before = driven(two_laps_odometry[:first], (), new_world_at=first - 4)
    assert before.map_from_world is None
    assert np.isnan(before.poses[first - 4 :]).all() and np.isfinite(before.poses[: first - 4]).all()
    after = driven(two_laps_odometry, second_lap_loops, new_world_at=first - 4)
    assert np.isfinite(after.poses).all()
    error = np.linalg.norm(after.poses[first:, :3, 3] - two_laps[first:, :3, 3], axis=1)
    assert error.max() < 4


def test_loops_of_an_unconnected_part_are_used_once_it_is_connected(two_laps_odometry, second_lap_loops):
    inside = LoopClosure(79, 76, inverse(two_laps_odometry[76]) @ two_laps_odometry[79], LOOP_COVARIANCE / 1e4, 0.99)
    earlier = LoopClosure(80, 77, inside.match_from_query @ transform(0.1, 0.0, 0.0), LOOP_COVARIANCE, 0.99)
    late = tuple(loop for loop in second_lap_loops if loop.query >= 84)
    with_loops = driven(two_laps_odometry, (inside, earlier, *late), new_world_at=70)
    without = driven(two_laps_odometry, late, new_world_at=70)
    assert np.isfinite(with_loops.poses).all()
    assert np.abs(with_loops.poses - without.poses).max() > 1e-4


def test_a_route_driven_again_and_again_needs_few_loops():
    laps, steps = 4, 40
    angle = np.linspace(0, 2 * np.pi * laps, laps * steps, endpoint=False)
    poses = np.stack([transform(40 * np.sin(a), 40 - 40 * np.cos(a), a) for a in angle])
    found = [LoopClosure(i, i - steps, np.eye(4), LOOP_COVARIANCE, 0.99) for i in range(steps, len(poses))]
    trajectory = driven(poses, found)
    np.testing.assert_allclose(trajectory.poses, poses, atol=1e-4)
    loops = trajectory._solver.getFactorsUnsafe().size() - len(trajectory._node_frames)
    travelled = 3 * 2 * np.pi * 40
    expected = travelled / (LOOP_EVERY * NODE_EVERY_M)
    assert expected - 2 <= loops <= expected + 1


@pytest.mark.parametrize("new_world_at", [None, 70])
def test_a_long_drive_has_a_bounded_graph(monkeypatch, two_laps, two_laps_odometry, second_lap_loops, new_world_at):
    whole = driven(two_laps_odometry, second_lap_loops, new_world_at=new_world_at)
    most = len(whole._node_frames) // 3
    monkeypatch.setattr(incremental, "MOST_NODES", most)
    few = driven(two_laps_odometry, second_lap_loops, new_world_at=new_world_at)
    assert most / 4 < len(few._node_frames) <= most and few.nbytes < whole.nbytes
    errors = [trajectory_error(trajectory.poses, two_laps[:, :3, 3]) for trajectory in (few, whole)]
    assert errors[0] < 1.4 * errors[1]
    np.testing.assert_allclose(few.map_from_world, few._correction_at(few._node_frames[-1]), atol=1e-9)
