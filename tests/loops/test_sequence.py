"""Neighbouring loops add up where they agree and the sensor has moved, and speak against each other where not."""

import numpy as np
import pytest

from sglpr_jax.loops.config import SequenceConfig
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.motion import Motion
from sglpr_jax.loops.sequence import added_log_odds, agree_in_motion, agree_in_order
from sglpr_jax.loops.transforms import inverse, transform


def loop(query: int, match: int, pose: np.ndarray | None = None) -> Loop:
    return Loop(query, match, np.eye(4) if pose is None else pose, np.eye(6), 0.9)


def moving(poses: list[np.ndarray | None]) -> Motion:
    motion = Motion()
    for frame, pose in enumerate(poses):
        motion.add(float(frame), pose=pose)
    return motion


def test_by_their_frames_matches_move_as_queries_do():
    loops = [loop(100, 10), loop(101, 12), loop(102, 60), loop(103, 7)]
    pairs = agree_in_order(loops)
    assert pairs[0].tolist() == [True, True, False, True] and (pairs == pairs.T).all()


def test_by_the_motion_the_circle_of_two_loops_closes():
    line = [transform(2.0 * frame, 0.0, 0.0) for frame in range(50)]
    back = [transform(98.0 - 2.0 * frame, 1.0, np.pi) for frame in range(50)]
    poses = line + back
    motion = moving(poses)
    right = [loop(q, m, inverse(poses[m]) @ poses[q]) for q, m in ((60, 39), (61, 38), (64, 36))]
    wrong = loop(62, 38, inverse(poses[38]) @ poses[62] @ transform(6.0, 0.0, 0.0))
    pairs = agree_in_motion([*right, wrong], motion, None)
    assert pairs[:3, :3].all() and not pairs[3, :3].any() and not pairs[:3, 3].any()


def test_without_a_known_motion_the_frames_decide():
    motion = moving([None] * 20)  # a segment a frame
    loops = [loop(15, 2), loop(16, 3), loop(17, 13)]
    np.testing.assert_array_equal(agree_in_motion(loops, motion, None), agree_in_order(loops))


@pytest.mark.parametrize(("step_m", "least", "most"), [(0.0, 0.0, 1e-9), (3.0, 0.18, 0.19), (150.0, 0.99, 1.0)])
def test_a_neighbour_counts_as_much_as_the_sensor_moved(step_m, least, most):
    motion = moving([transform(step_m * frame, 0.0, 0.0) for frame in range(3)])
    log_odds = np.array([1.0, 2.0])
    config = SequenceConfig(least_probability=0.5 + 0.5 * np.tanh(0.5))  # log odds of 1
    found = added_log_odds([loop(1, 0), loop(2, 0)], log_odds, np.ones((2, 2), bool), motion, config=config)
    assert least <= found[0] - log_odds[0] <= most


def test_neighbours_that_match_elsewhere_speak_against_a_loop_and_improbable_ones_do_not_count():
    motion = moving([transform(500.0 * frame, 0.0, 0.0) for frame in range(60)])
    loops = [loop(10, 0), loop(11, 5), loop(12, 0), loop(59, 0)]
    agreeing = np.array([[i == j or (i, j) in ((0, 2), (2, 0)) for j in range(4)] for i in range(4)])
    config = SequenceConfig(least_probability=0.5)
    found = added_log_odds(loops, np.array([3.0, 1.0, -2.0, 3.0]), agreeing, motion, config=config)
    np.testing.assert_allclose(found, [3.0 - 1.0 + 0.0, 1.0 - 3.0 - 0.0, -2.0 + 3.0 - 1.0, 3.0], atol=1e-6)


def test_one_frame_does_not_decide_for_another():
    motion = moving([transform(500.0 * frame, 0.0, 0.0) for frame in range(3)])
    found = added_log_odds([loop(1, 0), loop(2, 0)], np.array([0.0, 50.0]), np.ones((2, 2), bool), motion)
    assert found[0] == pytest.approx(SequenceConfig().max_log_odds)
