"""Settings and defaults of loops and maps, readable without JAX."""

import dataclasses
from typing import Annotated, Literal

from sglpr_jax.fields import Bounds, Count, NotNegative, Positive, Share, check_fields
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.registration.bev_config import VerificationConfig

Degenerate = Literal["keep", "drop"]
"""Whether degenerate loops are kept or rejected. Their position has a standard deviation of more than 1 m in one
horizontal direction, for example between plain walls."""
MIN_PROBABILITY = 0.99
"""Minimum probability of a returned loop."""
SPACING_M = 1.0
"""Minimum distance of consecutive places of a drive in a map, in metres."""
PlaceCount = Annotated[int, Bounds(1, 1000)]
PlaceCountOrZero = Annotated[int, Bounds(0, 1000)]
"""Number of places whose images are compared with a query. A comparison takes milliseconds. The second accepts 0."""
INDEPENDENT_M = 25.0
"""Travelled distance after which two frames are nearly independent, in metres: the radius of the compared images."""
MIN_CELLS = 20
"""Minimum number of occupied cells of an image. Images with fewer come from a blocked or failed sensor."""
CANDIDATES = 5
"""Number of places of a map that a query is compared with."""


@dataclasses.dataclass(frozen=True)
class CandidateConfig:
    """Selection of the scans that a query is compared with: possible matches, and scans that show other places."""

    further: PlaceCount = 32
    """Number of possible matches, those with the nearest descriptors, whose images are compared coarsely."""
    candidates: PlaceCount = 4
    """Maximum number of possible matches, the best by the coarse comparison, whose images are compared exactly."""
    good_correlation: float = 0.6
    """If no compared image has this correlation, the next `candidates` are compared exactly, too."""
    min_coarse_correlation: float = 0.3
    """Minimum correlation by the coarse comparison (`registration.bev_search`) of a match that is compared exactly."""
    min_correlation: float = 0.25
    """Minimum correlation of a candidate. Pairs below it are not loops."""
    cohort: PlaceCountOrZero = 24
    """Number of scans of other places than query and match, those with the nearest descriptors, that are compared.
    Queries without a match are compared with `candidates` of them."""
    near_cohort: PlaceCountOrZero = 8
    """Number of scans of the same passes, those with the nearest descriptors, that are compared. Their fits may
    contradict the motion."""
    recent_m: Positive = 30.0
    """Minimum travelled distance between a match and its query, in metres. Nearer scans belong to the same pass."""

    def __post_init__(self):
        """Raises ValueError if a field has an invalid value."""
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class DetectorConfig:
    """Thresholds for accepting a loop closure."""

    min_probability: Share = MIN_PROBABILITY
    """Minimum probability of a returned loop, given its neighbours."""
    keyframe_m: NotNegative = 2.5
    """Distance between keyframes, in metres, divided by the scale of the search. Only keyframes are described, searched
    for loops and stored. Where places look alike, the distance is a fifth of it. A scan that is turned by 20 degrees is
    a keyframe, too. 0 makes every scan a keyframe."""
    max_places: Count | None = None
    """Maximum number of stored scans. Beyond it, scans with a loop to a newer stored scan are forgotten first, then the
    oldest. None stores all."""
    candidates: CandidateConfig = CandidateConfig()
    verification: VerificationConfig = VerificationConfig()
    drift: DriftModel = DriftModel()
    """Drift of the odometry. Loops that contradict it are rejected."""

    def __post_init__(self):
        """Raises ValueError if a field has an invalid value."""
        check_fields(self)

    def at_scale(self, scale: float) -> "DetectorConfig":
        """The settings for scans with all lengths multiplied by `scale`. Settings of the images do not change."""
        return dataclasses.replace(self, drift=self.drift.at_scale(scale))
