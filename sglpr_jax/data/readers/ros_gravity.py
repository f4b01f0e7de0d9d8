"""Gravity of the scans of a bag by the IMU beside the LiDAR."""

import itertools

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.ros_bag import RosBag
from sglpr_jax.data.formats.ros_tracks import Stamps, fixed_transform, times_on_one_clock
from sglpr_jax.data.imu import Imu
from sglpr_jax.data.warning import warn
from sglpr_jax.files import naming


def imu_topic_of(bag: RosBag, lidar_topic: str, imu_topic: str | None) -> str | None:
    """Return `imu_topic`, or else the IMU topic whose name has most in common with the topic of the LiDAR, or None.

    Raises ValueError if `imu_topic` does not exist.
    """
    topics = bag.imu_topics
    if imu_topic is None:
        return max(topics, key=lambda topic: _shared(topic, lidar_topic), default=None)
    if imu_topic not in topics:
        raise ValueError(f"{bag.paths[0]}: expected the IMU topic {imu_topic}, found {', '.join(topics) or 'none'}")
    return imu_topic


def _shared(topic: str, other: str) -> int:
    """Number of parts that two topics have in common: 1 for /livox/imu and /livox/lidar."""
    parts = (name.strip("/").split("/") for name in (topic, other))
    return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], zip(*parts, strict=False)))


def ups_of_scans(
    bag: RosBag, topic: str, scans: Stamps, lidar: str, *, required: bool
) -> tuple[Float[np.ndarray, "n 3"], str] | None:
    """Return up in the frame of the LiDAR at each scan by an IMU, and the source in words. This reads the topic once.

    Arguments:
      bag: Bag of the scans.
      topic: Topic of the IMU.
      scans: Times of the scans.
      lidar: Frame of the LiDAR.
      required: Whether an IMU without gravity is an error. Otherwise the function warns and returns None.

    Raises:
      ValueError: If the bag is broken, or if `required` and the IMU does not measure gravity.
    """
    found = bag.imu(topic)
    source = f"{bag.paths[0]}, {topic}"
    stamps, times = times_on_one_clock(found.stamps, scans)
    order = np.argsort(stamps, kind="stable")
    turned = None if found.quaternions is None else found.quaternions[order]
    try:
        with naming(source):
            ups, how = Imu(stamps[order], found.rates[order], found.accelerations[order], turned).ups(times)
    except ValueError as error:
        if required:
            raise
        warn(f"{error}; the ground of the scans is used")
        return None
    return ups @ _lidar_from_imu(bag, found.frame.strip("/"), lidar, source).T, f"{topic}, by {how}"


def _lidar_from_imu(bag: RosBag, imu: str, lidar: str, source: str) -> Float[np.ndarray, "3 3"]:
    """Rotation from the IMU to the LiDAR by tf, or none with a warning."""
    if imu == lidar:
        return np.eye(3)
    found = fixed_transform(bag.transforms(), lidar, imu)
    if found is None:
        warn(
            f"{source}: expected a static transform from {imu} to {lidar}, found none; their axes are taken as parallel"
        )
        return np.eye(3)
    return found[:3, :3]
