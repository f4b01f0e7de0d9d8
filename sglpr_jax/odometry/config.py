"""Settings of odometry and of its drift, readable without JAX."""

import dataclasses
from typing import Literal

from sglpr_jax.fields import NotNegative, Positive, check_fields

OdometryFormat = Literal["auto", "kitti", "lidar", "tum", "g2o"]
"""Format of odometry. "kitti" and "lidar" have 12 numbers a line, in KITTI's camera axes or with z up. "tum" has time,
position and quaternion. "g2o" has the vertices of a graph."""
DRIFT_PERCENT = 1.0
"""Position drift of odometry: one standard deviation, in percent of the travelled distance."""
DRIFT_DEG_PER_100M = 0.5
"""Heading drift of odometry: one standard deviation, in degrees per 100 m of travelled distance."""
DRIFT_HEIGHT_PERCENT = 0.3
"""Height drift of odometry: one standard deviation, in percent of the travelled distance."""


@dataclasses.dataclass(frozen=True)
class DriftModel:
    """Standard deviations of odometry per metre of travelled distance."""

    metres_per_metre: NotNegative = DRIFT_PERCENT / 100
    """Position drift in the direction of travel."""
    degrees_per_metre: NotNegative = DRIFT_DEG_PER_100M / 100
    """Heading drift. It rotates the rest of the path and so moves the position, too."""
    sideways: NotNegative = 0.25
    """Position drift across the direction of travel, as a fraction of the drift along it."""
    height_per_metre: NotNegative = DRIFT_HEIGHT_PERCENT / 100
    """Height drift. A place on another floor of a building contradicts the odometry if this is small enough."""
    position_m: Positive = 0.5
    height_m: Positive = 0.3
    yaw_deg: Positive = 1.5
    """Standard deviations of the comparison itself, independent of the distance, in metres and degrees."""
    max_deviation: Positive = 4.0
    """Maximum deviation of a loop from the odometry. Loops beyond it contradict the odometry."""

    def __post_init__(self):
        """Raises ValueError if a drift is negative or not finite, or if another number is not positive."""
        check_fields(self)

    def scaled(self, factor: float) -> "DriftModel":
        """The same model with `factor` times the drift per metre."""
        names = ("metres_per_metre", "degrees_per_metre", "height_per_metre")
        return dataclasses.replace(self, **{name: factor * getattr(self, name) for name in names})

    def at_scale(self, scale: float) -> "DriftModel":
        """The drift of the same odometry with all translations multiplied by `scale`."""
        return dataclasses.replace(self, degrees_per_metre=self.degrees_per_metre / scale)

    def __str__(self) -> str:
        return f"{100 * self.metres_per_metre:.3g} % and {100 * self.degrees_per_metre:.3g} degrees per 100 m"


MOTION_DRIFT = DriftModel(metres_per_metre=0.01, degrees_per_metre=0.03, yaw_deg=2.5)
"""Drift of the motion that is used if there is no odometry (`odometry.bev_odometry`)."""


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
    def effective(self) -> "OdometryConfig":
        """The same settings with the edge of the voxels that is used."""
        return dataclasses.replace(self, voxel_m=self.max_range_m / 100 if self.voxel_m is None else self.voxel_m)
