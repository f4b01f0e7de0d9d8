"""The loops of a drive do not depend on its speed, on the rate of the sensor, or on the direction of its x axis."""

import dataclasses

import numpy as np
import pytest
from drives import PASS

from sglpr_jax.data.views import rotated
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import describe_scan
from sglpr_jax.se3 import inverse, transform, yaw_of

ANGLE = np.radians(137.0)
EVERY = list(range(2 * PASS))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rows", "factor", "turned", "share"),
    [
        (EVERY, 4, False, 0.6),
        (np.repeat(EVERY, 2).tolist(), None, False, 0.6),
        (EVERY[::2], 1, False, 0.4),
        (EVERY, 1, True, 0.6),
    ],
    ids=["slower", "twice without times", "every second", "turned"],
)
def test_the_loops_of_a_drive_stay_the_same_and_are_right(params, street, described, rows, factor, turned, share):
    """Without odometry. The first loops of a revisit need neighbours, so that not all scans have one."""
    poses, keyframe = street.poses.world_from_lidar, described
    if turned:
        records = [street.scan(row, labels=False) for row in EVERY]
        others = [dataclasses.replace(one, points=rotated(one.points, ANGLE)) for one in records]
        poses, keyframe = poses @ transform(0.0, 0.0, -ANGLE), [describe_scan(params, one) for one in others]
    detector = LoopDetector(params)
    for row in rows:
        detector.add_keyframe(keyframe[row], time=None if factor is None else factor * float(street.times[row]))
    for loop in detector.loops:
        query, match = rows[loop.query], rows[loop.match]
        error = inverse(inverse(poses[match]) @ poses[query]) @ loop.match_from_query
        assert np.linalg.norm(error[:2, 3]) < 0.5 and abs(np.degrees(yaw_of(error))) < 2
    found = {rows[loop.query] for loop in detector.loops}
    assert len(found) >= share * len({row for row in rows if row >= PASS})
