"""Settings of the loop detector from the flags that `bin/loops` and `bin/live` share."""

import dataclasses
from typing import Any

from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.odometry.config import DriftModel


def detector_config(command: Any) -> DetectorConfig:
    """Settings from a command that has the fields of `DetectorConfig`, and the drift as `drift_percent`,
    `drift_deg_per_100m` and `drift_height_percent`."""
    drift = DriftModel(
        metres_per_metre=command.drift_percent / 100,
        degrees_per_metre=command.drift_deg_per_100m / 100,
        height_per_metre=command.drift_height_percent / 100,
    )
    names = [field.name for field in dataclasses.fields(DetectorConfig) if field.name != "drift"]
    return DetectorConfig(drift=drift, **{name: getattr(command, name) for name in names})
