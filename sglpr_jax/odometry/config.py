"""Settings of odometry from scans, and formats of odometry files, readable without JAX."""

import dataclasses
from typing import Literal

from sglpr_jax.fields import NotNegative, Positive, check_fields

OdometryFormat = Literal["auto", "kitti", "lidar", "tum", "g2o"]
"""Format of a file of odometry. "kitti" and "lidar" have 12 numbers a line, in KITTI's camera axes or with z up. "tum"
has time, position and quaternion. "g2o" has the vertices of a graph. "auto" recognises the format."""


@dataclasses.dataclass(frozen=True)
class OdometryConfig:
    """Settings of odometry from the scans (kiss-icp). Lengths are divided by the scale of a recording."""

    max_range_m: Positive = 100.0
    """Maximum range of the points that are registered, in metres."""
    min_range_m: NotNegative = 0.0
    """Minimum range of the points, in metres. It excludes points on the vehicle."""
    voxel_m: Positive | None = None
    """Edge of the voxels of the local map, in metres. By default a hundredth of the maximum range."""

    def __post_init__(self):
        """Raises ValueError if a field has an invalid value or no range is left."""
        check_fields(self)
        if self.min_range_m >= self.max_range_m:
            raise ValueError(f"expected min_range_m < max_range_m = {self.max_range_m:g}, found {self.min_range_m:g}")

    @property
    def used_voxel_m(self) -> float:
        """Edge of the voxels that is used, in metres."""
        return self.max_range_m / 100 if self.voxel_m is None else self.voxel_m
