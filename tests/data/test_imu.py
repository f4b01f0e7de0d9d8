"""Up by an IMU: by its orientation, or by its accelerometer and gyroscope with noise and biases."""

import dataclasses

import numpy as np
import pytest
from bags import CLOUD, FILES, TRANSFORMS, cloud, header, transforms, typestore, write_bag
from clouds import street
from scipy.spatial.transform import Rotation

from sglpr_jax.data.imu import STANDARD_GRAVITY, Imu
from sglpr_jax.data.readers import open_recording
from sglpr_jax.files import DataWarning

IMU, DURATION_S, BEGIN_S = "sensor_msgs/msg/Imu", 40.0, 1000.0
STAMPS = BEGIN_S + np.arange(0, DURATION_S, 0.01)


def turned_at(times: np.ndarray) -> Rotation:
    """Rotation of the IMU in the hand of a person who walks along curves."""
    since = times - BEGIN_S
    angles = [40 * np.sin(0.2 * since), 10 * np.sin(3 * since), 12 * np.sin(2 * since + 1)]
    return Rotation.from_euler("zyx", np.stack(angles, axis=1), degrees=True)


def imu_of(*, noise: float = 0.0, gyro_bias: float = 0.0) -> Imu:
    """The samples of this IMU, with 1 m/s^2 of sway."""
    rng, turned = np.random.default_rng(0), turned_at(STAMPS)
    rates = 100 * (turned_at(STAMPS - 0.005).inv() * turned_at(STAMPS + 0.005)).as_rotvec() + gyro_bias
    sway = np.column_stack([np.sin(6 * STAMPS), np.cos(6 * STAMPS), np.sin(12 * STAMPS) + STANDARD_GRAVITY])
    accelerations = turned.inv().apply(sway) + noise * rng.normal(size=(len(STAMPS), 3))
    return Imu(STAMPS, rates + 0.1 * noise * rng.normal(size=rates.shape), accelerations)


def angles_deg(ups: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Angle between up in the frame of the IMU and true up."""
    return np.degrees(np.arccos(np.sum(ups * turned_at(times).as_matrix()[:, 2], axis=1).clip(-1, 1)))


TIMES = BEGIN_S + np.linspace(0, DURATION_S - 0.01, 97)


@pytest.mark.parametrize(("unit", "noise", "bias", "most"), [(STANDARD_GRAVITY, 0, 0, 1), (1, 0.1, 0.005, 2.5)])
def test_up_by_an_accelerometer_in_either_unit(unit, noise, bias, most):
    imu = imu_of(noise=noise, gyro_bias=bias)
    ups, how = dataclasses.replace(imu, accelerations=imu.accelerations / unit).ups(TIMES)
    assert angles_deg(ups, TIMES).max() < most and how == "its accelerometer and gyroscope"


def test_samples_that_are_missing_or_repeated():
    imu = imu_of()
    kept = np.flatnonzero((STAMPS < BEGIN_S + 15) | (STAMPS > BEGIN_S + 17)).repeat(2)
    rows = {name: getattr(imu, name)[kept] for name in ("times", "rates", "accelerations")}
    rows["accelerations"][::50] = np.nan
    ups, _ = Imu(**rows).ups(TIMES)
    inside = (TIMES > BEGIN_S + 15.3) & (TIMES < BEGIN_S + 16.7)
    assert np.isnan(ups[inside]).all() and angles_deg(ups, TIMES)[~np.isnan(ups[:, 0])].max() < 2


def test_an_orientation_is_used_if_the_accelerometer_agrees():
    imu = imu_of()
    right = dataclasses.replace(imu, quaternions=turned_at(STAMPS).as_quat())
    ups, how = right.ups(TIMES)
    assert angles_deg(ups, TIMES).max() < 0.1 and how == "its orientation"
    down = Rotation.from_euler("x", 180, degrees=True) * turned_at(STAMPS)  # axes north, east, down
    ups, how = dataclasses.replace(imu, quaternions=down.as_quat()).ups(TIMES)
    assert angles_deg(ups, TIMES).max() < 1 and how == "its accelerometer and gyroscope"
    free = dataclasses.replace(right, accelerations=0 * imu.accelerations)
    assert free.ups(TIMES)[1] == "its orientation"


def test_missing_gravity_is_one_clear_error():
    imu = imu_of()
    with pytest.raises(ValueError, match=r"expected accelerations with gravity, of 9.8 m/s\^2 or 1 g, found a median"):
        dataclasses.replace(imu, accelerations=0.2 * imu.accelerations).ups(TIMES)


def message_of(kind: str, seconds: float, rate, acceleration, quaternion=None, frame: str = "imu"):
    store = typestore(kind).types
    vector = store["geometry_msgs/msg/Vector3"]
    known = quaternion is not None
    return store[IMU](
        header=header(kind, seconds, frame),
        orientation=store["geometry_msgs/msg/Quaternion"](*map(float, quaternion if known else (0, 0, 0, 0))),
        orientation_covariance=np.array([0.0 if known else -1.0, *[0.0] * 8]),
        angular_velocity=vector(*map(float, rate)),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(*map(float, acceleration)),
        linear_acceleration_covariance=np.zeros(9),
    )


TILTED = Rotation.from_euler("xyz", [0, 0, 90], degrees=True)
"""Rotation from the IMU to the LiDAR."""


def ground(i: int, time: float) -> np.ndarray:
    """A street around the LiDAR."""
    world = street(i, height_m=1.4)
    world = world[world[:, 2] > 0.5] if i % 4 == 3 else world  # a scan that does not see the ground
    return TILTED.apply(turned_at(np.array([time])).inv().apply(world))


SCANS = BEGIN_S + np.arange(1.0, 9.0, 0.5)


def bag_of(path, kind, *, topics=("/livox/imu",), tf: bool = True, scale: float = 1.0):
    imu = imu_of(noise=0.05)
    samples = list(zip(STAMPS, imu.rates, scale * imu.accelerations, strict=True))[:1000:2]
    messages = [("/livox/lidar", CLOUD, time, cloud(kind, time, ground(i, time))) for i, time in enumerate(SCANS)]
    messages += [(topic, IMU, sample[0], message_of(kind, *sample)) for topic in topics for sample in samples]
    if tf:
        static = [("lidar", "imu", (0, 0, 0.1), TILTED.as_quat())]
        messages.append(("/tf_static", TRANSFORMS, BEGIN_S, transforms(kind, BEGIN_S, static)))
    return write_bag(path, kind, messages)


def test_gravity_of_a_bag(tmp_path):
    path = bag_of(tmp_path / FILES["mcap"], "mcap", topics=("/camera/imu", "/livox/imu"))
    recording = open_recording(path, gravity="scan")
    ups = np.array([one.up for one in recording.mountings])
    true = TILTED.apply(turned_at(SCANS).as_matrix()[:, 2])
    assert np.degrees(np.arccos(np.sum(ups * true, axis=1))).max() < 2
    assert max(one.tilt_deviation_deg for one in recording.mountings) < 1.5
    assert (
        "from the ground in 12 of 16 scans and from /livox/imu, by its accelerometer and gyroscope"
        in recording.found[-1]
    )
    assert recording.read_ups is None


@pytest.mark.slow
def test_topics_transforms_and_gravity_that_are_missing(tmp_path):
    path = bag_of(tmp_path / "a.bag", "ros1", tf=False)
    with pytest.raises(ValueError, match="expected the IMU topic /imu, found /livox/imu"):
        open_recording(path, imu_topic="/imu")
    with pytest.warns(DataWarning, match="expected a static transform from imu to lidar, found none; their axes are"):
        recording = open_recording(path, gravity="scan")
    assert "degrees apart from the ground and is not used" in recording.found[-1]
    free = bag_of(tmp_path / "b.bag", "ros1", scale=0.01)
    with pytest.warns(DataWarning, match="expected accelerations with gravity, .*; the ground of the scans is used"):
        assert "imu" not in open_recording(free, gravity="scan").found[-1]
    with pytest.raises(ValueError, match=r"b.bag, /livox/imu: expected accelerations with gravity, of 9.8 m/s\^2 or"):
        open_recording(free, gravity="scan", imu_topic="/livox/imu")
