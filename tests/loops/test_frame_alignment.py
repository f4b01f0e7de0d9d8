"""The transform between two frames follows from noisy loops, and wrong loops do not move it."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from session_pairs import loops_between, two_drives

from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.loops.frame_alignment import SegmentAlignment, TrajectorySegment, align_frames
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.se3 import inverse, transform, transform_covariance, travelled, yaw_of

EXACT = DriftModel(metres_per_metre=0.0, degrees_per_metre=0.0)


def aligned(loops, first, second, drift=EXACT):
    return align_frames(
        loops, first, second, match_travelled_m=travelled(first), query_travelled_m=travelled(second), drift=drift
    )


def error(loops, first, second, true) -> np.ndarray:
    return inverse(true) @ aligned(loops, first, second)[0]


def test_loops_with_noise_give_the_transform_to_centimetres_even_if_a_fifth_is_wrong():
    first, second, true = two_drives()
    loops = loops_between(first, second, true)
    found = error(loops, first, second, true)
    assert np.linalg.norm(found[:3, 3]) < 0.1 and abs(np.degrees(yaw_of(found))) < 0.1
    aside = transform(8.0, 0.0, 0.5)
    mixed = [
        dataclasses.replace(loop, match_from_query=aside @ loop.match_from_query) if i % 5 == 0 else loop
        for i, loop in enumerate(loops)
    ]
    found = error(mixed, first, second, true)
    assert np.linalg.norm(found[:3, 3]) < 0.25 and abs(np.degrees(yaw_of(found))) < 0.2


@pytest.mark.slow
def test_the_covariance_covers_the_errors_and_grows_with_the_stated_drift():
    first, second, true = two_drives()
    squares = []
    for seed in range(20):
        found, covariance = aligned(loops_between(first, second, true, seed=seed), first, second)
        apart = inverse(true) @ found
        planar = np.array([apart[0, 3], apart[1, 3], yaw_of(apart)])
        squares.append(planar @ np.linalg.solve(covariance[np.ix_([0, 1, 5], [0, 1, 5])], planar))
    assert np.mean(squares) < 3  # 3 for independent loops; neighbouring loops are not taken for independent
    loops = loops_between(first, second, true)
    exact, drifting = (aligned(loops, first, second, drift)[1] for drift in (EXACT, DriftModel()))
    assert (np.diag(drifting)[[0, 1, 5]] > 2 * np.diag(exact)[[0, 1, 5]]).all()


@pytest.mark.slow
@settings(deadline=None, max_examples=20)
@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-3.1, 3.1))
def test_other_frames_change_only_the_transform(x, y, yaw):
    first, second, true = two_drives()
    loops, moved = loops_between(first, second, true), transform(x, y, yaw)
    before, after = aligned(loops, first, second), aligned(loops, first, moved @ second)
    np.testing.assert_allclose(after[0] @ moved, before[0], atol=1e-5)
    expected = transform_covariance(before[1], moved)
    np.testing.assert_allclose(after[1], expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


def test_one_loop_is_enough_for_a_transform():
    loop = LoopClosure(1, 0, transform(1.0, 2.0, 0.3), np.eye(6), 0.99)
    poses = np.stack([np.eye(4), transform(5.0, 0.0, 0.0)])
    found, _ = aligned([loop], poses, poses)
    np.testing.assert_allclose(found @ poses[1], loop.match_from_query, atol=1e-9)


def test_a_transform_names_its_scans_unless_both_frames_are_those_of_odometry():
    match, query = TrajectorySegment(0, 0, 50, True), TrajectorySegment(1, 41, 99, False)
    transform_of_part = SegmentAlignment(match, query, np.eye(4), np.eye(6), 1)
    assert "of scans 0-50 and 41-99" in str(transform_of_part)
    assert "scans" not in str(transform_of_part._replace(query=query._replace(is_odometry=True)))
