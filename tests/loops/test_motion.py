"""The motion from frame to frame: by odometry, by registration, and unknown where that cannot be trusted."""

import numpy as np
import pytest

from sglpr_jax.loops.motion import UNKNOWN_M, Motion
from sglpr_jax.loops.pose_search import Peak
from sglpr_jax.loops.transforms import transform


def link(x: float, correlation: float = 0.9, second: float = 0.3, ridge: float = 0.2) -> Peak:
    return Peak(*map(np.float32, (x, 0.0, 0.0, correlation, second, ridge)))


def test_links_to_keyframes_add_up():
    motion = Motion()
    for frame in range(10):  # 1 m each; the keyframe is the last frame that was more than 3 m from the one before
        motion.add(float(frame), link=link(float(frame - motion.keyframe)) if frame else None)
    np.testing.assert_allclose([pose[0, 3] for pose in motion.poses], np.arange(10.0))
    np.testing.assert_allclose(motion.travelled, np.arange(10.0))
    np.testing.assert_allclose(motion.clock, np.arange(10.0))
    assert motion.keyframe == 8 and set(motion.segments) == {0}
    poses, known = motion.from_frame(9, np.array([0, 4]))
    np.testing.assert_allclose(poses[:, 0, 3], [9, 5])
    assert known.all()


WEAK = (link(1.0, correlation=0.3, second=0.1), link(1.0, second=1.4), link(1.0, ridge=0.8))


@pytest.mark.parametrize("weak", WEAK)
def test_a_few_links_that_cannot_be_trusted_continue_the_motion(weak):
    motion = Motion()
    for one in (None, link(1.0), weak, weak, weak, weak, link(1.0)):
        motion.add(float(len(motion)), link=one)
    assert motion.segments.tolist() == [0, 0, 0, 0, 0, 1, 1]
    np.testing.assert_allclose([pose[0, 3] for pose in motion.poses[:5]], np.arange(5.0))
    assert motion.from_frame(6, np.array([0, 5]))[1].tolist() == [False, True]
    assert motion.clock.tolist() == list(map(float, range(7)))


def test_across_a_gap_the_pose_is_a_guess_that_drifts():
    motion = Motion()
    for one in (None, link(1.0), *[None] * 4, link(1.0)):
        motion.add(0.5 * len(motion), link=one)
    assert motion.segments.tolist() == [0, 0, 0, 0, 0, 1, 1]
    np.testing.assert_allclose([pose[0, 3] for pose in motion.poses], np.arange(7.0))
    second = motion.config.guess_m_per_s
    np.testing.assert_allclose(motion.guessed_m, np.array([0, 0, 0.5, 1.0, 1.5, 2.0, 2.0]) * second)


def test_a_clear_peak_anywhere_comes_before_the_expected_one():
    motion, expected = Motion(), link(1.0, correlation=0.5, second=0.7)
    assert motion.link(link(9.0), expected).x == 9
    assert motion.link(link(9.0, second=0.85), expected).x == 1


def test_another_peak_is_no_matter_where_the_pose_is_expected():
    motion = Motion()
    for one in (None, link(1.0, second=0.7), link(2.0, second=1.2)):
        motion.add(float(len(motion)), link=one)
    assert motion.segments.tolist() == [0, 0, 0]
    np.testing.assert_allclose(motion.prior(3.0), [3.0, 0.0, 0.0], atol=1e-9)
    assert np.isnan(motion.prior(9.0)).all()  # too long after


def test_the_clock_stops_where_the_sensor_stands():
    motion = Motion()
    for frame in range(40):
        motion.add(float(frame), link=link(0.0) if frame else None)
    assert motion.clock[-1] == motion.config.standing_s and motion.travelled[-1] == 0
    assert motion.near_last(10.0, np.arange(len(motion))).all()


def test_odometry_is_taken_as_it_is():
    motion = Motion()
    for frame in range(30):
        motion.add(float(frame), pose=transform(0.5 * frame, 0.0, 0.1 * frame))
    assert motion.travelled[-1] == pytest.approx(14.5) and set(motion.segments) == {0}
    assert motion.near_last(10.0, np.arange(len(motion))).sum() == 20


def test_after_an_unknown_motion_nothing_is_known_about_the_way():
    motion = Motion()
    for i in range(3):
        motion.add(float(i), pose=transform(float(i), 0.0, 0.0))
    motion.add(3.0, pose=transform(500.0, 0.0, 1.0), continues=False)
    motion.add(4.0, pose=transform(501.0, 0.0, 1.0))
    assert motion.segments.tolist() == [0, 0, 0, 1, 1] and motion.keyframe == 3
    assert motion.near_last(10.0, np.arange(5)).tolist() == [False, False, False, True, True]
    assert motion.path.travelled[3] - motion.path.travelled[2] >= UNKNOWN_M
    np.testing.assert_allclose(np.diff(motion.path.travelled)[[0, 1, 3]], 1.0, rtol=1e-6)
    unknown = Motion()
    for i in range(3):
        unknown.add(float(i), link=link(1.0) if i else None)
    unknown.add(3.0, link=link(1.0), continues=False)
    assert unknown.segments.tolist() == [0, 0, 0, 1]
