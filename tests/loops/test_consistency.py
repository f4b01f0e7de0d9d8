"""Right loops agree with each other whatever the odometry has drifted, wrong ones do not; the largest set is found."""

import itertools
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.loops.closure import Loop, planar_loop
from sglpr_jax.loops.consistency import BLOCK, agree, largest_consistent_set
from sglpr_jax.registration.bev_alignment import Alignment
from sglpr_jax.se3 import inverse, transform


def square_drive(laps: int = 2, side: int = 50) -> np.ndarray:
    """Poses (n, 4, 4) of laps about a square, one each metre."""
    poses = []
    for _, edge, step in itertools.product(range(laps), range(4), range(side)):
        corner = np.array([(0, 0), (side, 0), (side, side), (0, side)])[edge]
        yaw = edge * np.pi / 2
        poses.append(transform(*(corner + step * np.array([np.cos(yaw), np.sin(yaw)])), yaw))
    return np.stack(poses)


def drifted(
    poses: np.ndarray, rng: np.random.Generator, *, share: float = 0.01, deg_per_m: float = 0.005
) -> np.ndarray:
    """Odometry of the drive, its scale and heading off by so much."""
    scale, turn = 1 + rng.normal(scale=share), rng.normal(scale=np.radians(deg_per_m))
    steps = inverse(poses[:-1]) @ poses[1:]
    found = [np.eye(4)]
    for step in steps:
        step = step.copy()
        step[:3, 3] *= scale
        found.append(found[-1] @ step @ transform(0.0, 0.0, turn))
    return np.stack(found)


def loop_of(poses: np.ndarray, query: int, match: int, error: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Loop:
    relative = inverse(poses[match]) @ poses[query] @ transform(*error)
    yaw = np.arctan2(relative[1, 0], relative[0, 0])
    covariance = np.diag([0.05, 0.05, np.radians(0.3)]) ** 2
    return planar_loop(query, match, Alignment(*relative[:2, 3], yaw, covariance, 0.8, 0.3), probability=0.99)


@pytest.mark.slow
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 10**6))
def test_right_loops_agree_and_wrong_ones_do_not(seed):
    rng = np.random.default_rng(seed)
    poses = square_drive()
    odometry = drifted(poses, rng)
    right = [loop_of(poses, i, i - 200, tuple(rng.normal(scale=[0.1, 0.1, 0.005]))) for i in range(210, 290, 4)]
    wrong = [loop_of(poses, i, i - 200, (15.0 * (-1) ** i, 5.0, 0.0)) for i in range(212, 290, 13)]
    pairs = agree(right + wrong, odometry)
    assert pairs[:20, :20].mean() > 0.98
    near = np.abs(np.subtract.outer([one.query for one in right], [one.query for one in wrong])) < 20
    assert not pairs[:20, 20:][near].any()
    kept = largest_consistent_set(pairs)
    assert len(kept) >= 19 and kept.max() < 20


def test_a_loop_in_the_other_direction_agrees_with_one_in_the_same():
    poses = square_drive()
    back = poses.copy()
    back[200:] = poses[200:] @ transform(0.0, 0.0, np.pi)
    assert agree([loop_of(back, 230, 30), loop_of(back, 240, 40)], back).all()
    turned = [loop_of(back, 230, 30), loop_of(back, 240, 40, (0.0, 0.0, np.pi))]
    assert not agree(turned, back)[0, 1]


def test_agreement_goes_both_ways_and_with_itself():
    poses = square_drive()
    rng = np.random.default_rng(0)
    loops = [loop_of(poses, i, i - 200, tuple(rng.normal(scale=[2, 2, 0.1]))) for i in range(205, 285, 5)]
    pairs = agree(loops, drifted(poses, rng))
    assert pairs.diagonal().all()
    assert (pairs == pairs.T).mean() > 0.9  # the lever is that of one of the two
    np.testing.assert_array_equal(agree(loops, poses, loops[:3]), agree(loops, poses)[:, :3])


def test_no_loops_are_no_pairs():
    assert agree([], square_drive()).shape == (0, 0)


@settings(deadline=None, max_examples=40)
@given(n=st.integers(1, 9), seed=st.integers(0, 10**6))
def test_the_set_is_consistent_and_nearly_the_largest(n, seed):
    half = np.triu(np.random.default_rng(seed).random((n, n)) < 0.6, 1)
    pairs = half | half.T | np.eye(n, dtype=bool)
    found = largest_consistent_set(pairs)
    assert pairs[np.ix_(found, found)].all()
    sizes = range(n, 0, -1)
    best = next(k for k in sizes if any(pairs[np.ix_(s, s)].all() for s in itertools.combinations(range(n), k)))
    assert len(found) >= best - 1


def chosen_by_the_letter(pairs: np.ndarray, starts: int = 20) -> list[int]:
    """The largest set as its docstring says, with all degrees taken anew for each member."""
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
    pairs = rng.random((n, n)) < np.sqrt(share)  # some agree one way alone, some not with themselves
    assert largest_consistent_set(pairs).tolist() == chosen_by_the_letter(pairs)


def test_loops_are_compared_block_by_block():
    poses, rng = square_drive(), np.random.default_rng(0)
    queries = rng.integers(205, 395, 5 * BLOCK + 3).tolist()
    loops = [loop_of(poses, i, i - 200, tuple(rng.normal(scale=[1, 1, 0.05]))) for i in queries]
    odometry = drifted(poses, rng)
    tracemalloc.start()
    pairs = agree(loops, odometry)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 80 * len(loops) ** 2  # bytes; all at once took 150 a pair
    for row in range(0, len(loops), 41):
        np.testing.assert_array_equal(pairs[row], agree([loops[row]], odometry, loops)[0])


def test_nothing_to_choose_from():
    assert len(largest_consistent_set(np.zeros((0, 0), bool))) == 0
    assert largest_consistent_set(np.ones((1, 1), bool)).tolist() == [0]


def test_the_covariance_of_a_loop_is_that_of_a_motion_in_the_querys_frame():
    """Unsure along the match's x; the query is turned by 90 degrees, so along its own y."""
    covariance = np.diag([4.0, 0.01, 0.001])
    loop = planar_loop(9, 1, Alignment(1.0, 2.0, np.pi / 2, covariance, 0.8, 0.3), probability=0.9)
    np.testing.assert_allclose(loop.covariance.diagonal()[[0, 1, 5]], [0.01, 4.0, 0.001], atol=1e-9)
    np.testing.assert_allclose(loop.information @ loop.covariance, np.eye(6), atol=1e-9)
    assert loop.yaw == pytest.approx(np.pi / 2)
    rng = np.random.default_rng(0)
    motions = rng.multivariate_normal(np.zeros(2), loop.covariance[:2, :2], 4000)
    moved = np.stack([(loop.match_from_query @ transform(*motion, 0.0))[:2, 3] for motion in motions])
    np.testing.assert_allclose(np.cov(moved.T), covariance[:2, :2], atol=0.3)
