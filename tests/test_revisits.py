"""The rule of LoGG3D-Net for queries, databases and revisits."""

import json

import hypothesis
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
from recordings import kitti_trajectory

from sglpr_jax.revisits import database_end, revisits
from sglpr_jax.same_place import EXCLUDED_FRAMES, EXCLUDED_S


@hypothesis.settings(deadline=None, max_examples=25)
@hypothesis.given(hnp.arrays(np.float64, 40, elements=st.floats(0, 3)), st.floats(0.3, 20))
def test_the_database_follows_the_rule_word_for_word(steps, scale):
    times = np.cumsum(steps * scale)
    expected = []
    for query, now in enumerate(times):
        k = next(frame for frame, time in enumerate(times) if time > now - EXCLUDED_S)
        expected.append(0 if now - times[0] < EXCLUDED_S else min(k + 1, query))
    np.testing.assert_array_equal(database_end(40, times=times), expected)


def test_without_times_frames_are_the_clock():
    ends = database_end(1000)
    assert not ends[:EXCLUDED_FRAMES].any()
    np.testing.assert_array_equal(ends[EXCLUDED_FRAMES:], np.arange(EXCLUDED_FRAMES, 1000) - EXCLUDED_FRAMES + 2)
    seconds = np.arange(1000.0) * EXCLUDED_S / EXCLUDED_FRAMES
    assert np.abs(ends - database_end(1000, times=seconds)).max() <= 1


def test_no_frames_have_no_database():
    assert database_end(0).shape == (0,)
    assert revisits(np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize("times", [[0.0, 2.0, 1.0], [0.0, np.nan, 1.0]])
def test_decreasing_times_are_refused(times):
    with pytest.raises(ValueError, match="never decrease"):
        database_end(3, times=np.array(times))


def test_a_loop_is_a_revisit_and_standing_still_is_not():
    turn = np.linspace(0, 4 * np.pi, 80, endpoint=False)  # two rounds of 40 frames in 60 s
    circle, times = np.stack([50 * np.cos(turn), 50 * np.sin(turn), np.zeros(80)], axis=1), np.arange(80) * 1.5
    np.testing.assert_array_equal(revisits(circle, times=times), np.arange(80) >= 40)
    assert not revisits(np.zeros((20, 3)), times=times[:20]).any()


def test_height_counts_only_in_3d():
    climb, times = np.zeros((100, 3)), np.arange(100) * 1.5
    climb[:, 2] = np.arange(100)
    assert not revisits(climb, times=times).any()
    assert revisits(climb[:, :2], times=times)[20:].all()


@pytest.mark.slow
@pytest.mark.parametrize("sequence, count", [("00", 777), ("02", 296), ("08", 321)])
def test_revisits_of_kitti_are_the_published_ones(shared, sequence, count):
    published = json.loads((shared / "data/protocol/logg3d_is_revisit_D-3_T-30.json").read_text())[sequence]
    positions, times, _ = kitti_trajectory(shared / "data/kitti_odometry", sequence, pose_source="semantickitti")
    found = revisits(positions, times=times)
    assert found.sum() == count
    np.testing.assert_array_equal(found, np.array(published) == 1)
    assert revisits(positions).sum() == count  # 290 frames stand for 30 s
