"""Correct loops are consistent at any drift of the odometry and wrong ones are not. The largest set is found."""

import itertools

import numpy as np
import pytest
from drives import drifted, loop_at
from hypothesis import given, settings
from hypothesis import strategies as st
from session_pairs import loops_between, two_drives

from sglpr_jax.loops.closure import LoopClosure, planar_loop
from sglpr_jax.loops.consistency import MIN_LOOPS, accept_between, are_consistent, largest_consistent_set
from sglpr_jax.odometry.bev_odometry import BevOdometry
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.se3 import inverse, transform


def square_drive(laps: int = 2, side: int = 50) -> np.ndarray:
    """Poses (n, 4, 4) of laps about a square, one each metre."""
    poses = []
    for _, edge, step in itertools.product(range(laps), range(4), range(side)):
        corner = np.array([(0, 0), (side, 0), (side, side), (0, side)])[edge]
        yaw = edge * np.pi / 2
        poses.append(transform(*(corner + step * np.array([np.cos(yaw), np.sin(yaw)])), yaw))
    return np.stack(poses)


def loop_of(
    poses: np.ndarray, query: int, match: int, error: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> LoopClosure:
    relative = inverse(poses[match]) @ poses[query] @ transform(*error)
    yaw = np.arctan2(relative[1, 0], relative[0, 0])
    covariance = np.diag([0.05, 0.05, np.radians(0.3)]) ** 2
    return planar_loop(query, match, BevRegistration(*relative[:2, 3], yaw, covariance, 0.8, 0.3), probability=0.99)


@pytest.mark.slow
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 10**6))
def test_right_loops_agree_and_wrong_ones_do_not(seed):
    rng = np.random.default_rng(seed)
    poses = square_drive()
    odometry = drifted(poses, percent=rng.normal(), deg_per_100m=rng.normal(scale=0.5))
    right = [loop_of(poses, i, i - 200, tuple(rng.normal(scale=[0.1, 0.1, 0.005]))) for i in range(210, 290, 4)]
    wrong = [loop_of(poses, i, i - 200, (15.0 * (-1) ** i, 5.0, 0.0)) for i in range(212, 290, 13)]
    pairs = are_consistent(right + wrong, DrivenPath(odometry))
    assert pairs[:20, :20].mean() > 0.98
    near = np.abs(np.subtract.outer([one.query for one in right], [one.query for one in wrong])) < 20
    assert not pairs[:20, 20:][near].any()
    kept = largest_consistent_set(pairs)
    assert len(kept) >= 19 and kept.max() < 20


def test_a_loop_in_the_other_direction_agrees_with_one_in_the_same():
    poses = square_drive()
    back = poses.copy()
    back[200:] = poses[200:] @ transform(0.0, 0.0, np.pi)
    assert are_consistent([loop_of(back, 230, 30), loop_of(back, 240, 40)], DrivenPath(back)).all()
    turned = [loop_of(back, 230, 30), loop_of(back, 240, 40, (0.0, 0.0, np.pi))]
    assert not are_consistent(turned, DrivenPath(back))[0, 1]


def chosen_by_the_letter(pairs: np.ndarray, starts: int = 20) -> list[int]:
    """Greedy search as in `largest_consistent_set`, but with the degrees counted from scratch for each member."""
    pairs, best = pairs & pairs.T, []
    for start in np.argsort(-pairs.sum(1), kind="stable")[:starts]:
        members, left = [start], np.flatnonzero(pairs[start] & (np.arange(len(pairs)) != start))
        while len(left):
            members.append(left[np.argmax(pairs[np.ix_(left, left)].sum(1))])
            left = left[pairs[members[-1], left] & (left != members[-1])]
        best = max(best, members, key=len)
        if len(best) > len(pairs) / 2:
            break
    return sorted(best)


@settings(deadline=None, max_examples=60)
@given(n=st.integers(0, 60), share=st.sampled_from([0.1, 0.5, 0.9, 1.0]), seed=st.integers(0, 10**6))
def test_the_set_is_the_one_that_all_degrees_taken_anew_choose(n, share, seed):
    rng = np.random.default_rng(seed)
    pairs = rng.random((n, n)) < np.sqrt(share)  # some are consistent one way alone, some not with themselves
    assert largest_consistent_set(pairs).tolist() == chosen_by_the_letter(pairs)


def test_the_covariance_of_a_loop_is_that_of_a_motion_in_the_querys_frame():
    """The position is uncertain along the match's x axis, which is the y axis of the query, turned by 90 degrees."""
    covariance = np.diag([4.0, 0.01, 0.001])
    loop = planar_loop(9, 1, BevRegistration(1.0, 2.0, np.pi / 2, covariance, 0.8, 0.3), probability=0.9)
    np.testing.assert_allclose(loop.covariance.diagonal()[[0, 1, 5]], [0.01, 4.0, 0.001], atol=1e-9)
    np.testing.assert_allclose(loop.information @ loop.covariance, np.eye(6), atol=1e-9)
    assert loop.yaw == pytest.approx(np.pi / 2)
    rng = np.random.default_rng(0)
    motions = rng.multivariate_normal(np.zeros(2), loop.covariance[:2, :2], 4000)
    moved = np.stack([(loop.match_from_query @ transform(*motion, 0.0))[:2, 3] for motion in motions])
    np.testing.assert_allclose(np.cov(moved.T), covariance[:2, :2], atol=0.3)


RULES = {"drift": DriftModel()}
FIRST, SECOND, TRUE = two_drives()
MOTION = BevOdometry.joined([BevOdometry.of(FIRST), BevOdometry.of(SECOND)])


def joined_loops(true: np.ndarray) -> list[LoopClosure]:
    """Loops that follow this transform. Their frames count through both recordings, one after the other."""
    rng = np.random.default_rng(3)
    return [
        loop_at(len(FIRST) + one.query, one.match, one.match_from_query, rng)
        for one in loops_between(FIRST, SECOND, true)
    ]


def test_a_few_wrong_loops_are_rejected_and_the_others_accepted():
    right, rng = joined_loops(TRUE), np.random.default_rng(0)
    wrong = [
        loop_at(len(FIRST) + query, match, transform(*rng.uniform(-5, 5, 2), rng.uniform(-3, 3)), rng)
        for query, match in ((3, 40), (30, 5), (50, 70), (60, 20))
    ]
    mixed = sorted([*right, *wrong], key=lambda loop: loop.query)
    sets, rejected = accept_between(mixed, MOTION, **RULES)
    assert [len(one) for one in sets] == [len(right)]
    assert {id(one.loop) for one in rejected} == set(map(id, wrong))
    assert {one.reason for one in rejected} == {"contradicts other loops"}


def test_too_few_loops_or_too_short_a_path_are_no_common_place():
    loops = joined_loops(TRUE)
    for some in (loops[: MIN_LOOPS - 1], loops[: MIN_LOOPS + 2], []):  # 5 loops are 2 m apart: 8 m
        sets, rejected = accept_between(some, MOTION, **RULES)
        assert sets == [] and len(rejected) == len(some)
        assert {one.reason for one in rejected} <= {"too few neighbours"}


def test_the_path_between_two_days_of_a_map_is_no_drift():
    middle, rng = len(FIRST) // 2, np.random.default_rng(3)
    days = np.concatenate([FIRST[:middle], transform(5000.0, 0.0, 0.0)[None], FIRST[middle:]])
    motion, loops = BevOdometry.joined([BevOdometry.of(days), BevOdometry.of(SECOND)]), []
    for is_second_day, true in ((False, TRUE), (True, transform(4.0, 0.0, 0.0) @ TRUE)):
        near = [loop for loop in loops_between(FIRST, SECOND, true) if (loop.match >= middle) == is_second_day]
        loops += [
            loop_at(len(days) + loop.query, loop.match + is_second_day, loop.match_from_query, rng) for loop in near
        ]
    sets, rejected = accept_between(sorted(loops, key=lambda loop: loop.query), motion, **RULES, known=len(days))
    assert len(sets) == 1 and {one.loop.match > middle for one in rejected} == {True}


def test_a_place_that_repeats_gives_two_transforms_and_therefore_none():
    farther = transform(12.0, 0.0, 0.0) @ TRUE
    both = sorted([*joined_loops(TRUE), *joined_loops(farther)], key=lambda loop: loop.query)
    sets, rejected = accept_between(both, MOTION, **RULES)
    assert sets == [] and len(rejected) == len(both)


def test_parts_without_known_motion_are_accepted_one_by_one():
    loops = joined_loops(TRUE)
    middle = int(np.median([loop.query for loop in loops]))
    offset, parts = middle - len(FIRST) + 1, [BevOdometry.of(FIRST)]
    parts += [BevOdometry.of(some) for some in (SECOND[:offset], SECOND[offset:])]
    sets, rejected = accept_between(loops, BevOdometry.joined(parts), **RULES)
    assert len(sets) == 2 and sum(map(len, sets)) == len(loops) and not rejected
