"""Drift of odometry per metre of travelled distance, readable without JAX."""

import dataclasses

from sglpr_jax.fields import NotNegative, Positive, check_fields

DRIFT_PERCENT = 1.0
"""Position drift of odometry: one standard deviation, in percent of the travelled distance."""
DRIFT_DEG_PER_100M = 0.5
"""Heading drift of odometry: one standard deviation, in degrees per 100 m of travelled distance."""
DRIFT_HEIGHT_PERCENT = 0.3
"""Height drift of odometry: one standard deviation, in percent of the travelled distance."""


@dataclasses.dataclass(frozen=True)
class DriftModel:
    """Drift of odometry: standard deviations that grow with the travelled distance, and limit for contradictions."""

    metres_per_metre: NotNegative = DRIFT_PERCENT / 100
    """Position drift in the direction of travel, per metre of travelled distance."""
    degrees_per_metre: NotNegative = DRIFT_DEG_PER_100M / 100
    """Heading drift, in degrees per metre. It rotates the rest of the path and so moves the position, too."""
    sideways: NotNegative = 0.25
    """Position drift across the direction of travel, as a fraction of the drift along it."""
    height_per_metre: NotNegative = DRIFT_HEIGHT_PERCENT / 100
    """Height drift per metre. If it is small, loops between two floors of a building contradict the odometry."""
    position_m: Positive = 0.5
    height_m: Positive = 0.3
    yaw_deg: Positive = 1.5
    """Standard deviations at any distance, in metres and degrees, from the registration of the two scans."""
    max_deviation: Positive = 4.0
    """Number of standard deviations beyond which a loop contradicts the odometry."""

    def __post_init__(self):
        """Raises ValueError if a drift is negative or not finite, or if another number is not positive."""
        check_fields(self)

    @classmethod
    def largest(cls, *drifts: "DriftModel") -> "DriftModel":
        """The largest value of each number of one or several models."""
        return cls(*map(max, zip(*map(dataclasses.astuple, drifts), strict=True)))

    def scaled(self, factor: float) -> "DriftModel":
        """The same model with `factor` times the drift per metre."""
        names = ("metres_per_metre", "degrees_per_metre", "height_per_metre")
        return dataclasses.replace(self, **{name: factor * getattr(self, name) for name in names})

    def at_scale(self, scale: float) -> "DriftModel":
        """The drift of the same odometry after all its translations were multiplied by `scale`."""
        return dataclasses.replace(self, degrees_per_metre=self.degrees_per_metre / scale)

    def __str__(self) -> str:
        return f"{100 * self.metres_per_metre:.3g} % and {100 * self.degrees_per_metre:.3g} degrees per 100 m"


MOTION_DRIFT = DriftModel(metres_per_metre=0.01, degrees_per_metre=0.03, yaw_deg=2.5)
"""Drift of the motion by images, which replaces missing odometry (`odometry.bev_odometry`)."""
