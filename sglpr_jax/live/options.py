"""Options of sources and sinks. Those of `bin/live` are flags."""

import dataclasses
from pathlib import Path

import tyro

from sglpr_jax.data.choices import PoseFormat, ScanFormat, SensorHeight, TimeUnit
from sglpr_jax.fields import NotNegative


@dataclasses.dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """Options of all sources and sinks. Each uses those that apply to it."""

    topic: str | None = None
    """Topic of the point clouds, by default /points. The single topic of a bag is always used."""
    odometry_topic: str | None = None
    """Topic of the odometry. Without odometry, loops are found by the scans alone."""
    reliable: bool = False
    """Request lost scans again (dds). Publishers that are best effort then do not match."""
    rate: NotNegative = 1.0
    """Speed of a replayed bag. 0 is as fast as possible."""
    poses: Path | None = None
    """File of odometry for a folder, which may grow: tum, or a line for each scan."""
    pose_format: PoseFormat = "auto"
    """Format of --poses. 12 numbers a line are kitti (camera axes) or lidar (z up), and 8 numbers are tum."""
    time_unit: TimeUnit = "auto"
    """Unit of the times in --poses. `auto` expects seconds."""
    format: ScanFormat = "auto"
    """Format of the scan files of a folder."""
    sensor_height: SensorHeight = "auto"
    """Height of the sensor above the ground, in metres. `auto` estimates height and tilt from the first scans."""
    topic_prefix: tyro.conf.Suppress[str] = "/sglpr"
    """Beginning of the names of published topics. A setting of --config, as the next two."""
    map_frame: tyro.conf.Suppress[str] = "map"
    """Name of the map's frame in published messages."""
    odometry_frame: tyro.conf.Suppress[str] = "odom"
    """Name of the odometry's frame in published messages."""
