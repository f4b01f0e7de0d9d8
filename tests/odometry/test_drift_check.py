"""The drift of odometry is estimated from images of a drive whose true motion is known."""

import numpy as np
import pytest
from drives import along, drifted

from sglpr_jax.odometry.drift_check import OdometryCheck
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.se3 import inverse, transform, yaw_of

TRUE = along([(0, 0), (150, 0), (150, 150)], 3.0)


def checked(odometry: np.ndarray, *, second: float = 0.3, steps: int = len(TRUE)) -> OdometryCheck:
    """The check after a drive with this odometry. The images show the true motion, and a second peak."""
    check = OdometryCheck()
    for row in range(steps):
        assert check.is_due(odometry[row])
        moved = inverse(TRUE[row - 1]) @ TRUE[row]
        link = BevRegistration(*moved[:2, 3], yaw_of(moved), np.diag([0.01, 0.01, 0.0]), 0.8, second)
        check.add(odometry[row], link if row else None)
    return check


@pytest.mark.parametrize(("percent", "deg_per_100m"), [(0.0, 0.0), (10.0, 5.0), (-10.0, -5.0)])
def test_the_estimate_is_the_drift(percent, deg_per_100m):
    check, stated = checked(drifted(TRUE, percent=percent, deg_per_100m=deg_per_100m)), DriftModel()
    found = check.drift(stated)
    least = stated.metres_per_metre, stated.degrees_per_metre
    assert found.metres_per_metre == pytest.approx(max(least[0], abs(percent) / 100), rel=0.2)
    assert found.degrees_per_metre == pytest.approx(max(least[1], abs(deg_per_100m) / 100), rel=0.3)
    assert not check.is_unusable


def test_odometry_of_another_length_is_unusable_and_ambiguous_images_or_few_show_nothing():
    double = drifted(TRUE, percent=100, deg_per_100m=0)
    assert checked(double).is_unusable
    assert checked(double, second=0.9).errors == (0.0, 0.0) == checked(double, steps=12).errors


def test_a_scan_is_due_after_some_metres_or_some_degrees():
    check = OdometryCheck()
    check.add(np.eye(4), None)
    for pose, due in (
        (transform(0.5, 0.0, 0.1), False),
        (transform(3.0, 0.0, 0.0), True),
        (transform(0.0, 0.0, 0.5), True),
    ):
        assert check.is_due(pose) == due
