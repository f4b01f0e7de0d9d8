"""Flags of the loop detector, which `bin/loops` and `bin/live` share."""

import dataclasses

from sglpr_jax.loops.config import MIN_PROBABILITY, CandidateConfig, DetectorConfig
from sglpr_jax.odometry.config import DRIFT_DEG_PER_100M, DRIFT_PERCENT, DriftModel
from sglpr_jax.registration.config import VerificationConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectorFlags:
    """Settings of the loop detector, with the drift of the odometry in usual units."""

    drift_percent: float = DRIFT_PERCENT
    """Position drift of the odometry: one standard deviation, in percent of the travelled distance. Loops that need
    more than four standard deviations are rejected."""
    drift_deg_per_100m: float = DRIFT_DEG_PER_100M
    """Heading drift of the odometry: one standard deviation, in degrees per 100 m."""
    min_probability: float = MIN_PROBABILITY
    """Minimum probability of a loop."""
    keyframe_m: float = DetectorConfig.keyframe_m
    """Minimum distance of a stored scan from the previous one, in metres. 0 stores every scan."""
    max_places: int | None = DetectorConfig.max_places
    """Maximum number of stored scans, to limit memory. By default all are stored."""
    candidates: CandidateConfig = DetectorConfig.candidates
    verification: VerificationConfig = DetectorConfig.verification

    @property
    def detector(self) -> DetectorConfig:
        """Settings of the detector. Raises ValueError if one of them is invalid."""
        drift = DriftModel(metres_per_metre=self.drift_percent / 100, degrees_per_metre=self.drift_deg_per_100m / 100)
        names = [field.name for field in dataclasses.fields(DetectorConfig) if field.name != "drift"]
        return DetectorConfig(drift=drift, **{name: getattr(self, name) for name in names})
