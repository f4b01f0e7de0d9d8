"""Settings of the point cloud and of the occupancy grid of a map."""

from dataclasses import dataclass

from sglpr_jax.fields import NotNegative, Positive, check_fields


@dataclass(frozen=True)
class CloudConfig:
    """Settings of a point cloud."""

    voxel_m: Positive = 0.1
    """Edge of a voxel, in metres. The cloud has one point per voxel."""
    reach_m: Positive = 40.0
    """Maximum distance of a point from the sensor, in metres."""
    spacing_m: NotNegative = 0.5
    """Minimum distance between the scans that are used, in metres."""
    keep_moving: bool = False
    """Keep the points of moving objects."""

    def __post_init__(self):
        check_fields(self)


@dataclass(frozen=True)
class OccupancyConfig:
    """Settings of an occupancy grid."""

    cell_m: Positive = 0.1
    """Edge of a cell, in metres."""
    step_m: Positive = 0.3
    """Maximum height of a step that a robot drives over, in metres. Higher points are obstacles."""
    robot_height_m: Positive = 2.0
    """Height of the robot, in metres. It drives beneath points that are higher above the ground."""
    robot_radius_m: NotNegative = 0.3
    """Radius of the robot, in metres. Where it drove, cells within this distance are free."""

    def __post_init__(self):
        check_fields(self)
