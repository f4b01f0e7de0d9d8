"""The motion from frame to frame: by odometry, by registration, and unknown where that cannot be trusted."""

import numpy as np
import pytest

from sglpr_jax.odometry.bev_odometry import AMBIGUOUS_SHARE, GAP_M, GUESS_FACTOR, MAX_COASTING, UNKNOWN_M, BevOdometry
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.se3 import transform


def link(
    x: float, correlation: float = 0.9, second: float = 0.3, along_m: float = 0.1, turned_deg: float = 0.0
) -> BevRegistration:
    spread = np.diag([along_m, along_m, 0.0]) ** 2
    return BevRegistration(*map(np.float32, (x, 0.0, np.radians(turned_deg), spread, correlation, second)))


def moved(links: list[BevRegistration | None], *, factor: float = 1.0) -> BevOdometry:
    """Motion of frames 0.1 s apart with these registrations with the reference. Times are multiplied by `factor`."""
    motion = BevOdometry()
    for frame, one in enumerate(links):
        motion.add(0.1 * factor * frame, link=one)
    return motion


def test_links_to_references_add_up():
    motion = BevOdometry()
    for frame in range(10):  # 1 m each; the reference is the last frame that was more than 3 m from the one before
        motion.add(float(frame), link=link(float(frame - motion.reference)) if frame else None)
    for found in ([pose[0, 3] for pose in motion.poses], motion.travelled):
        np.testing.assert_allclose(found, np.arange(10.0))
    assert motion.reference == 8 and set(motion.segments) == {0}


def test_across_a_gap_the_pose_is_a_guess_that_drifts():
    most = MAX_COASTING
    motion = moved([None, link(1.0), *[None] * (most + 1), link(1.0)])
    assert motion.segments.tolist() == [0] * (most + 2) + [1] * 2
    np.testing.assert_allclose([pose[0, 3] for pose in motion.poses], np.arange(most + 4.0))
    guessed = [0, 0, *range(1, most + 2), most + 1]
    np.testing.assert_allclose(motion.guessed_m, np.array(guessed) * GUESS_FACTOR)
    np.testing.assert_allclose(motion.travelled[: most + 4], np.arange(most + 4.0))


WEAK = (link(1.0, correlation=0.1), link(1.0, second=1.0), link(1.0, along_m=1.0))


@pytest.mark.parametrize("weak", WEAK)
def test_a_link_that_may_be_wrong_is_not_trusted(weak):
    motion = moved([None])
    assert motion.is_trusted(link(1.0), motion.prior(0.1, 0)) and not motion.is_trusted(weak, motion.prior(0.1, 0))


def test_another_peak_is_no_matter_where_the_pose_is_expected():
    motion = moved([None, link(1.0, second=0.7), link(2.0, second=0.85)])
    assert motion.segments.tolist() == [0, 0, 0] and motion.guessed_m.tolist() == [0, 0, 0]
    np.testing.assert_allclose(motion.prior(0.3, 0), [3.0, 0.0, 0.0], atol=1e-9)
    ambiguous = link(3.0, second=0.85)
    assert motion.is_trusted(ambiguous, motion.prior(0.3, 0)) and not motion.is_trusted(ambiguous, np.full(3, 9.0))
    assert np.isnan(motion.prior(0.9, 0)).all()  # too long after


@pytest.mark.parametrize("turned_deg,drifts", [(80.0, False), (100.0, True), (-179.0, True)])
def test_a_sensor_that_seems_to_turn_round_at_once_may_be_in_another_row(turned_deg, drifts):
    motion = moved([None, link(1.0), link(1.5, turned_deg=turned_deg)])
    share = AMBIGUOUS_SHARE * GUESS_FACTOR
    np.testing.assert_allclose(motion.guessed_m, [0, 0, share * drifts])


def test_a_link_after_a_gap_drifts_by_what_the_sensor_may_have_moved_meanwhile():
    motion = BevOdometry()
    for time, one in ((0.0, None), (0.1, link(1.0)), (0.2, link(2.0)), (1.2, link(2.5)), (1.3, link(3.5))):
        motion.add(time, link=one)
    share = AMBIGUOUS_SHARE * GUESS_FACTOR
    np.testing.assert_allclose(motion.guessed_m[:4], [0, 0, 0, 10 * share])
    assert set(motion.segments) == {0}


@pytest.mark.parametrize("factor", [0.25, 1e9])
def test_a_drive_at_another_speed_has_the_same_motion(factor):
    links = [None, link(1.0), *[None] * 6, link(2.0), link(3.5), link(1.0, second=0.85)]
    slow, fast = moved(links), moved(links, factor=factor)
    np.testing.assert_allclose(fast.poses, slow.poses, atol=1e-6)
    np.testing.assert_allclose(fast.guessed_m, slow.guessed_m)
    assert fast.segments.tolist() == slow.segments.tolist()


def test_after_an_unknown_motion_nothing_is_known_about_the_way():
    motion = BevOdometry()
    for i in range(3):
        motion.add(float(i), pose=transform(float(i), 0.0, 0.0))
    motion.add(3.0, pose=transform(500.0, 0.0, 1.0), continues=False)
    motion.add(4.0, pose=transform(501.0, 0.0, 1.0))
    assert motion.segments.tolist() == [0, 0, 0, 1, 1] and motion.reference == 3
    assert motion.path.travelled[3] - motion.path.travelled[2] >= UNKNOWN_M
    np.testing.assert_allclose(np.diff(motion.path.travelled)[[0, 1, 3]], 1.0, rtol=1e-6)


def straight(frames: int) -> BevOdometry:
    motion = BevOdometry()
    for frame in range(frames):
        motion.add(float(frame), pose=transform(4.0 * frame, 0.0, 0.0))
    return motion


def test_joined_motions_keep_their_poses_and_are_apart():
    first, second = straight(5), straight(3)
    joined = BevOdometry.joined([first, second])
    assert joined.segments.tolist() == [0] * 5 + [1] * 3 and len(joined) == 8
    np.testing.assert_array_equal(joined.poses[5:], second.poses)
    np.testing.assert_allclose(np.diff(joined.travelled), [4, 4, 4, 4, GAP_M, 4, 4])
