"""A process that publishes point clouds and poses by DDS with cyclonedds' own types, as a node of ROS 2 would.

Usage: dds_talker.py DOMAIN RELIABILITY CLOUD_TYPE
"""

import sys
import time
from dataclasses import dataclass

import numpy as np
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float32, float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time
    frame_id: str


@dataclass
class PointField(IdlStruct, typename="sensor_msgs.msg.dds_.PointField_"):
    name: str
    offset: uint32
    datatype: uint8
    count: uint32


@dataclass
class PointCloud2(IdlStruct, typename="sensor_msgs.msg.dds_.PointCloud2_"):
    header: Header
    height: uint32
    width: uint32
    fields: sequence[PointField]
    is_bigendian: bool
    point_step: uint32
    row_step: uint32
    data: sequence[uint8]
    is_dense: bool


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Transform(IdlStruct, typename="geometry_msgs.msg.dds_.Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs.msg.dds_.TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs.msg.dds_.TFMessage_"):
    transforms: sequence[TransformStamped]


@dataclass
class LaserScan(IdlStruct, typename="sensor_msgs.msg.dds_.LaserScan_"):
    header: Header
    ranges: sequence[float32]
    unused: array[float32, 2]


def cloud(stamp: Time) -> PointCloud2:
    points = np.arange(60, dtype=np.float32).reshape(20, 3)
    fields = [PointField(name, 4 * at, 7, 1) for at, name in enumerate("xyz")]
    data = list(points.tobytes())
    return PointCloud2(Header(stamp, "lidar"), 1, 20, fields, False, 12, len(data), data, True)


def transform(stamp: Time, frame: str, child: str, *at: float) -> TFMessage:
    moved = Transform(Vector3(*at), Quaternion(0.0, 0.0, 0.0, 1.0))
    return TFMessage([TransformStamped(Header(stamp, frame), child, moved)])


def main() -> None:
    domain, reliability, kind = sys.argv[1:]
    participant = DomainParticipant(int(domain))
    reliable = Policy.Reliability.Reliable(duration(milliseconds=100))
    latched = Qos(reliable, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
    qos = Qos(reliable if reliability == "reliable" else Policy.Reliability.BestEffort, Policy.History.KeepLast(5))
    fixed = DataWriter(participant, Topic(participant, "rt/tf_static", TFMessage), qos=latched)
    fixed.write(transform(Time(0, 0), "base", "lidar", 0.0, 0.0, 2.0))
    tf = DataWriter(participant, Topic(participant, "rt/tf", TFMessage), qos=qos)
    of = {"PointCloud2": PointCloud2, "LaserScan": LaserScan}[kind]
    scans = DataWriter(participant, Topic(participant, "rt/points", of), qos=qos)
    for step in range(400):
        stamp = Time(100 + step // 20, step % 20 * 50_000_000)
        tf.write(transform(stamp, "odom", "base", step * 0.1, 0.0, 0.0))
        scans.write(cloud(stamp) if of is PointCloud2 else LaserScan(Header(stamp, "lidar"), [], [0.0, 0.0]))
        time.sleep(0.05)


if __name__ == "__main__":
    main()
