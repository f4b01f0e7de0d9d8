"""Points of the messages of every driver, of Livox's own message, and messages that are broken."""

import numpy as np
import pytest
from bags import FILES, LIVOX_DRIVERS, livox, typestore, write_bag
from clouds import DRIVERS, cloud, points_of
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.data.formats.ros_messages import RosMessage, read_custom_msg, read_point_cloud2
from sglpr_jax.data.readers import open_recording
from sglpr_jax.files import DataWarning


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("height", "padding"), [(1, 0), (4, 10)])
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
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "expected a scan of at most 16777216 points, found 1844674"),
        ({"width": 2**20, "point_step": 2**31}, "expected a scan of at most 536870912 bytes"),
        ({"point_step": 0, "row_step": 0}, "expected 1 rows of 24 points of 0 bytes, found 528 bytes"),
    ],
)
def test_broken_clouds(change, message):
    broken = cloud(points_of(0))
    vars(broken).update(change)
    with pytest.raises(ValueError, match=message):
        read_point_cloud2(broken)


def test_fields_of_other_types_are_refused():
    broken = cloud(points_of(0))
    broken.fields[0].datatype = 9
    with pytest.raises(ValueError, match=r"expected numbers of types 1 to 8, found \[9, 7, 7, 4\]"):
        read_point_cloud2(broken)


@pytest.mark.parametrize("driver", ["velodyne", "turned about"])
def test_a_big_endian_flag_on_little_endian_points(driver):
    flagged = cloud(points_of(0), driver)
    flagged.is_bigendian = True
    with pytest.warns(DataWarning, match=r"drive: expected big-endian points, as is_bigendian states, found little"):
        found = read_point_cloud2(flagged, name="drive")
    np.testing.assert_array_equal(found.points, points_of(0))
    np.testing.assert_array_equal(found.lasers, np.arange(24) % 16)


@settings(deadline=None, max_examples=20)
@given(n=st.integers(1, 40), frame=st.text("abc_/", max_size=9), kind=st.sampled_from(("ros1", "ros2")))
def test_points_and_lines_of_livox_are_those_of_rosbags(n, frame, kind):
    types, points = typestore(kind), np.nan_to_num(points_of(0, max(n, 4))[:n])
    name = f"{LIVOX_DRIVERS[0]}/msg/CustomMsg"
    message = livox(kind, 5.0, points, frame=frame)
    raw = bytes(types.serialize_ros1(message, name) if kind == "ros1" else types.serialize_cdr(message, name))
    found = read_custom_msg(RosMessage(raw, cdr=kind == "ros2"))
    np.testing.assert_array_equal(found.points, points)
    np.testing.assert_array_equal(found.lasers, np.arange(n) % 6)
    assert found.time_field.name == "offset_time"
    np.testing.assert_array_equal(found.time_field.values, 7 * np.arange(n))
    if kind == "ros2":
        swapped = bytes(types.serialize_cdr(message, name, little_endian=False))
        np.testing.assert_array_equal(read_custom_msg(RosMessage(swapped, cdr=True)).points, points)
    for length in (5, 20, len(raw) // 2, len(raw) - 2):
        with pytest.raises(ValueError, match=r"expected a message of at least \d+ bytes, found"):
            read_custom_msg(RosMessage(raw[:length], cdr=kind == "ros2"))


@pytest.mark.parametrize(("kind", "driver"), [("ros1", LIVOX_DRIVERS[0]), ("mcap", LIVOX_DRIVERS[1])])
def test_a_bag_of_livox_is_a_recording(tmp_path, kind, driver):
    clouds = [np.nan_to_num(points_of(i)) for i in range(3)]
    messages = [
        ("/livox/lidar", f"{driver}/msg/CustomMsg", 100 + i / 10, livox(kind, 50 + i, points, driver=driver))
        for i, points in enumerate(clouds)
    ]
    recording = open_recording(write_bag(tmp_path / FILES[kind], kind, messages), sensor_height=1.0)
    assert "Livox, offset_time x y z reflectivity tag line" in recording.found[0]
    np.testing.assert_allclose(recording.times, [50, 51, 52])
    scan = recording.scan(2)
    np.testing.assert_array_equal(scan.points, clouds[2])
    np.testing.assert_array_equal(scan.lasers, np.arange(24) % 6)
