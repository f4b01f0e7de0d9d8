"""Livox's own message: rosbags writes it by its definition, and what is read by hand is the same."""

import numpy as np
import pytest
from bags import FILES, header, typestore, write_bag
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.data.formats.ros_messages import RosMessage, read_custom_msg
from sglpr_jax.data.readers import open_recording

DRIVERS = ("livox_ros_driver", "livox_ros_driver2")


def points_of(scan: int, n: int = 24) -> np.ndarray:
    return np.random.default_rng(scan).normal(scale=9, size=(n, 3)).astype(np.float32)


def message_of(kind: str, points: np.ndarray, *, driver: str = DRIVERS[0], frame: str = "livox", time: float = 5.0):
    store = typestore(kind).types
    point = store[f"{driver}/msg/CustomPoint"]
    return store[f"{driver}/msg/CustomMsg"](
        header=header(kind, time, frame),
        timebase=12345678901234,
        point_num=len(points),
        lidar_id=1,
        rsvd=np.zeros(3, np.uint8),
        points=[
            point(offset_time=7 * i, x=float(x), y=float(y), z=float(z), reflectivity=250, tag=16, line=i % 6)
            for i, (x, y, z) in enumerate(points)
        ],
    )


@settings(deadline=None, max_examples=20)
@given(n=st.integers(1, 40), frame=st.text("abc_/", max_size=9), kind=st.sampled_from(("ros1", "ros2")))
def test_points_and_lines_are_those_of_rosbags(n, frame, kind):
    types, points = typestore(kind), points_of(0, n)
    name = "livox_ros_driver/msg/CustomMsg"
    serialize = types.serialize_ros1 if kind == "ros1" else types.serialize_cdr
    raw = bytes(serialize(message_of(kind, points, frame=frame), name))
    found = read_custom_msg(RosMessage(raw, cdr=kind == "ros2"))
    np.testing.assert_array_equal(found.points, points)
    np.testing.assert_array_equal(found.lasers, np.arange(n) % 6)
    assert found.time_field.name == "offset_time"
    np.testing.assert_array_equal(found.time_field.values, 7 * np.arange(n))
    if kind == "ros2":
        swapped = bytes(types.serialize_cdr(message_of(kind, points, frame=frame), name, little_endian=False))
        np.testing.assert_array_equal(read_custom_msg(RosMessage(swapped, cdr=True)).points, points)


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("driver", DRIVERS)
def test_a_bag_of_livox_is_a_recording(tmp_path, kind, driver):
    clouds = (
        (
            "/livox/lidar",
            f"{driver}/msg/CustomMsg",
            100 + i / 10,
            message_of(kind, points_of(i), driver=driver, time=50 + i),
        )
        for i in range(3)
    )
    recording = open_recording(write_bag(tmp_path / FILES[kind], kind, clouds), sensor_height=1.0)
    assert len(recording) == 3 and "Livox, offset_time x y z reflectivity tag line" in recording.found[0]
    np.testing.assert_allclose(recording.times, [50, 51, 52])
    record = recording.record(2, lasers=True)
    np.testing.assert_array_equal(record.points, points_of(2))
    np.testing.assert_array_equal(record.lasers, np.arange(24) % 6)


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
def test_a_message_that_is_cut_off_is_refused(kind):
    types = typestore(kind)
    serialize = types.serialize_ros1 if kind == "ros1" else types.serialize_cdr
    raw = bytes(serialize(message_of(kind, points_of(0)), "livox_ros_driver/msg/CustomMsg"))
    for length in (5, 20, len(raw) // 2, len(raw) - 2):
        with pytest.raises(ValueError, match=r"expected \d+ times \d+ bytes, found"):
            read_custom_msg(RosMessage(raw[:length], cdr=kind == "ros2"))
