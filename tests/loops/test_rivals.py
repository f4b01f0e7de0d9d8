"""Rivals are other places of the same surroundings, and count unless the motion explains how well they fit."""

import numpy as np
import pytest

from sglpr_jax.loops.motion import Motion
from sglpr_jax.loops.pose_search import NO_PEAKS, Peak
from sglpr_jax.loops.rivals import distance_share, expected_poses, rival_share, rivals
from sglpr_jax.loops.transforms import transform


def straight(frames: int, step_m: float = 1.0) -> Motion:
    motion = Motion()
    for frame in range(frames):
        motion.add(float(frame), pose=transform(step_m * frame, 0.0, 0.0))
    return motion


def peaks(x: list[float], correlation: list[float], second: list[float]) -> Peak:
    zeros = np.zeros(len(x))
    return Peak(np.array(x), zeros, zeros, np.array(correlation), np.array(second), zeros)


def test_rivals_come_from_before_the_query_and_around_the_match():
    motion, descriptors = straight(201), np.zeros((200, 2))
    descriptors[:, 0] = 1.0
    descriptors[[180, 192], 0] = 0.1  # the nearest of its stretch, and one that is too young
    frames = np.arange(200)
    found = rivals(np.zeros(2), descriptors, frames, 60, motion, exclude_s=30.0)
    age, around = 200 - found[found > 100], np.abs(found[found < 100] - 60)
    assert len(age) == 6 and len(around) == 4 and 180 in found and 192 not in found
    assert age.min() >= 8 and age.max() <= 29.2 and around.min() >= 8 and around.max() <= 29.2
    stored = frames[frames % 3 == 0]
    assert set(stored[rivals(np.zeros(2), descriptors[stored], stored, 60, motion, exclude_s=30.0)] % 3) == {0}
    assert len(rivals(np.zeros(2), descriptors[:0], frames[:0], 60, motion, exclude_s=30.0)) == 0


def test_a_rival_that_fits_as_well_is_evidence_against():
    unknown = np.tile(np.eye(4), (2, 1, 1)), np.full(2, np.nan)
    found = peaks([0.0, 5.0], [0.4, 0.7], [0.3, 0.2])
    assert rival_share(found, 0.8, [unknown]) == pytest.approx(0.7 / 0.8)
    assert np.isnan(rival_share(NO_PEAKS, 0.8, []))


def test_a_rival_that_overlaps_the_query_fits_rightly_at_the_pose_of_the_motion():
    motion, rows = straight(20), np.array([10, 14])
    expected = expected_poses(motion, 19, rows, np.eye(4))
    np.testing.assert_allclose(expected[0][:, 0, 3], [9, 5])
    assert rival_share(peaks([9.5, 5.0], [0.7, 0.8], [0.3, 0.2]), 0.9, [expected]) == pytest.approx(0.3 / 0.9)
    assert rival_share(peaks([0.0, 5.0], [0.7, 0.8], [0.3, 0.2]), 0.9, [expected]) == pytest.approx(0.7 / 0.9)


def test_descriptors_of_rivals_count_where_they_do_not_overlap():
    expected = expected_poses(straight(100), 99, np.array([50, 95]), np.eye(4))
    assert distance_share(0.4, np.array([0.8, 0.2]), [expected]) == pytest.approx(0.5)
    assert np.isnan(distance_share(0.4, np.array([0.2]), [(expected[0][1:], expected[1][1:])]))
