"""The travelled distance of a trajectory is that of its poses."""

import numpy as np

from sglpr_jax.loops.trajectory import Trajectory
from sglpr_jax.loops.transforms import travelled

from .drives import town


def test_poses_are_kept_and_their_distance_is_the_same_to_the_bit():
    poses, found = town(), Trajectory()
    for pose in poses:
        found.add(pose)
    np.testing.assert_array_equal(found.poses, poses)
    np.testing.assert_array_equal(found.travelled, travelled(poses))
