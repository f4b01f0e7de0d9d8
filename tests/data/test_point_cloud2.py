"""Points of a PointCloud2 message: the fields of every driver, and messages that are broken."""

import numpy as np
import pytest
from clouds import DRIVERS, cloud, points_of

from sglpr_jax.data.formats.ros_messages import described_fields, read_point_cloud2
from sglpr_jax.data.warning import DataWarning


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("height", "padding"), [(1, 0), (4, 0), (4, 10)])
def test_every_driver(driver, order, height, padding):
    found = read_point_cloud2(cloud(points_of(0), driver, order=order, height=height, padding=padding))
    np.testing.assert_array_equal(found.points, points_of(0))
    np.testing.assert_array_equal(found.lasers, np.arange(24) % 16)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 25}, "expected 1 rows of 25 points of 22 bytes, found 528 bytes"),
        ({"width": 0}, "expected at least one point, found none"),
        ({"fields": []}, "expected the fields x, y and z, found none"),
        ({"point_step": 6}, "expected fields within 6 bytes, found others"),
    ],
)
def test_broken_clouds(change, message):
    broken = cloud(points_of(0))
    vars(broken).update(change)
    with pytest.raises(ValueError, match=message):
        read_point_cloud2(broken)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "expected a scan of at most 16777216 points, found 1844674"),
        ({"width": 2**20, "point_step": 2**31}, "expected a scan of at most 536870912 bytes"),
        ({"point_step": 0, "row_step": 0}, "expected 1 rows of 24 points of 0 bytes, found 528 bytes"),
    ],
)
def test_sizes_that_no_cloud_has(change, message):
    broken = cloud(points_of(0))
    vars(broken).update(change)
    with pytest.raises(ValueError, match=message):
        read_point_cloud2(broken)


@pytest.mark.parametrize("driver", ["velodyne", "turned about"])
def test_a_big_endian_flag_on_little_endian_points(driver):
    flagged = cloud(points_of(0), driver)
    flagged.is_bigendian = True
    with pytest.warns(DataWarning, match=r"drive: expected big-endian points, as is_bigendian states, found little"):
        found = read_point_cloud2(flagged, name="drive")
    np.testing.assert_array_equal(found.points, points_of(0))
    np.testing.assert_array_equal(found.lasers, np.arange(24) % 16)


def test_fields_of_other_types_are_refused():
    broken = cloud(points_of(0))
    broken.fields[0].datatype = 9
    with pytest.raises(ValueError, match=r"expected numbers of types 1 to 8, found \[9, 7, 7, 4\]"):
        read_point_cloud2(broken)
    assert described_fields(broken) == "x y z intensity ring (22 bytes a point)"
