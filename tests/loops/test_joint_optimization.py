"""Two drifted drives are corrected together, in the frame of the first one."""

import dataclasses

import numpy as np
import pytest

from sglpr_jax.loops.search_between import FoundRecordings
from sglpr_jax.pose_graph.optimize import optimize_recordings, placements, trajectory_error
from sglpr_jax.se3 import inverse

from .drives import drifted
from .pairs import found_pair, two_drives


def test_the_recordings_fit_together_better_than_by_one_transform():
    first, second, true = two_drives()
    odometry = drifted(first, percent=1, deg_per_100m=0.5), drifted(second, percent=-1, deg_per_100m=-0.5)
    found = found_pair(odometry=odometry)
    corrected = optimize_recordings(found)
    assert corrected.groups == ((0, 1),) and corrected.corrections[0].inliers.all()
    np.testing.assert_allclose(corrected.poses[0][0], odometry[0][0], atol=1e-5)
    truth = np.concatenate([first, true @ second])[:, :3, 3]
    (_, own), (group, placed) = placements(found)
    assert group == 0 and np.array_equal(own, np.eye(4))
    before = trajectory_error(np.concatenate([odometry[0], placed @ odometry[1]]), truth)
    after = trajectory_error(np.concatenate(corrected.poses), truth)
    assert after < 0.8 * before


def test_recordings_without_a_common_place_stay_as_they_are():
    found = found_pair()
    none = dataclasses.replace(found.between[0], loops=(), aligned=())
    corrected = optimize_recordings(dataclasses.replace(found, between=(none,)))
    assert corrected.groups == ((0,), (1,))
    for poses, one in zip(corrected.poses, found.recordings, strict=True):
        np.testing.assert_allclose(poses, one.odometry, atol=1e-9)


def test_a_third_recording_is_placed_through_the_second():
    pair = found_pair()
    second = dataclasses.replace(pair.between[0], match=1, query=2)
    chain = FoundRecordings((*pair.recordings, pair.recordings[1]), (pair.between[0], second))
    step = pair.between[0].aligned[0].alignment.match_from_query
    np.testing.assert_allclose([to for _, to in placements(chain)], [np.eye(4), step, step @ step], atol=1e-9)
    backwards = FoundRecordings(chain.recordings, (dataclasses.replace(second, match=0), second))
    found = placements(backwards)
    assert [group for group, _ in found] == [0, 0, 0]
    np.testing.assert_allclose(found[1][1], step @ inverse(step), atol=1e-9)


def test_loops_without_odometry_are_refused():
    found = found_pair()
    bare = tuple(dataclasses.replace(one, odometry=None) for one in found.recordings)
    with pytest.raises(ValueError, match="monday: expected loops found with odometry"):
        optimize_recordings(dataclasses.replace(found, recordings=bare))
