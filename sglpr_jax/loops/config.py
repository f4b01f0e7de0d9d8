"""Settings of the loop detector as plain values, readable without JAX. `bin/loops` has a flag for each."""

import dataclasses
import math

from sglpr_jax.data.density_grid import RESOLUTION_M
from sglpr_jax.fields import NotNegative, Positive, check_fields
from sglpr_jax.loops.choices import (
    DRIFT_DEG_PER_100M,
    DRIFT_HEIGHT_PERCENT,
    DRIFT_PERCENT,
    MIN_PROBABILITY,
    PlaceCount,
    PlaceCountOrNone,
)


def _check_probability(name: str, value: float) -> None:
    if not 0 <= value <= 1:
        raise ValueError(f"expected {name} from 0 to 1, found {value}")


@dataclasses.dataclass(frozen=True)
class DriftModel:
    """Standard deviations of odometry per metre of travelled distance."""

    metres_per_metre: float = DRIFT_PERCENT / 100
    """Position drift in the direction of travel."""
    degrees_per_metre: float = DRIFT_DEG_PER_100M / 100
    """Heading drift. It rotates the rest of the path and so moves the position, too."""
    sideways: float = 0.25
    """Position drift across the direction of travel, as a fraction of the drift along it."""
    height_per_metre: float = DRIFT_HEIGHT_PERCENT / 100
    """Height drift. A place on another floor of a building contradicts the odometry if this is small enough."""
    position_m: float = 0.5
    height_m: float = 0.3
    yaw_deg: float = 1.5
    """Standard deviations of the comparison itself, independent of the distance, in metres and degrees."""
    max_deviation: float = 4.0
    """Maximum deviation of a loop from the odometry. Loops beyond it contradict the odometry."""

    def __post_init__(self):
        """Raises ValueError if a drift is negative or not finite, or if another number is not positive."""
        for name, value in dataclasses.asdict(self).items():
            positive = name in ("position_m", "height_m", "yaw_deg", "max_deviation")
            if not math.isfinite(value) or value < 0 or (positive and value == 0):
                raise ValueError(f"expected {name} {'> 0' if positive else '>= 0'}, found {value}")

    def scaled(self, factor: float) -> "DriftModel":
        """The same model with `factor` times the drift per metre."""
        names = ("metres_per_metre", "degrees_per_metre", "height_per_metre")
        return dataclasses.replace(self, **{name: factor * getattr(self, name) for name in names})

    def __str__(self) -> str:
        return f"{100 * self.metres_per_metre:.3g} % and {100 * self.degrees_per_metre:.3g} degrees per 100 m"


MOTION_DRIFT = DriftModel(metres_per_metre=0.01, degrees_per_metre=0.03, yaw_deg=2.5)
"""Drift of the motion that is used if there is no odometry (`loops.motion`)."""


@dataclasses.dataclass(frozen=True)
class MotionConfig:
    """Thresholds for accepting a registration with the keyframe and for choosing the next keyframe."""

    min_correlation: float = 0.15
    """Minimum correlation of the two images."""
    max_along_m: float = 0.25
    """Maximum standard deviation of the pose along its least certain direction, in metres. Above it, the images do not
    show how far the sensor moved, as between walls."""
    min_expected: float = 0.8
    """Minimum correlation near the expected pose, divided by that at the best pose, if the best pose is less certain
    than `max_along_m`. Above it, the sensor is assumed to move on as before."""
    max_second: float = 0.8
    max_second_of_jump: float = 0.6
    max_second_expected: float = 0.95
    """Maximum second-peak ratio, that of a pose far from the expected one, and that of the expected pose."""
    expected_m: float = 1.0
    expected_deg: float = 5.0
    """Maximum distance of a pose from the expected one, in metres and degrees."""
    max_jump: float = 2.0
    """Distance from the expected pose, as a multiple of the last step, beyond which a pose is far from it."""
    max_coasting: int = 3
    """Maximum number of consecutive frames whose registration is rejected and whose pose is extrapolated."""
    keyframe_m: float = 3.0
    keyframe_deg: float = 20.0
    """Distance or angle from the keyframe beyond which a frame becomes the next keyframe, in metres and degrees."""
    guess_factor: float = 300.0
    """Length of measured path with the same drift as one metre of guessed motion, in metres."""
    ambiguous_share: float = 0.25
    """Share of a step that counts as guessed if its link is ambiguous."""
    m_per_uncertain_m: float = 100.0
    """Length of measured path with the same drift as one metre of uncertainty along a wall, in metres."""
    least_step_m: float = 0.5
    unknown_step_m: float = 12.0
    """Minimum length of a guessed step, and its length if the speed was never known, in metres."""


@dataclasses.dataclass(frozen=True)
class CandidateConfig:
    """Selection of the scans that a query is compared with: possible matches, and scans that show other places."""

    further: PlaceCount = 32
    """Number of nearest descriptors among the possible matches whose images are compared on coarse cells."""
    candidates: PlaceCount = 4
    """Number of these, the best by the coarse comparison, whose images are compared exactly."""
    good_correlation: float = 0.6
    """If no compared image has this correlation, as many further ones are compared exactly."""
    min_coarse_correlation: float = 0.3
    """Minimum correlation by the coarse comparison (`loops.shortlist`) of a possible match that is compared exactly."""
    min_correlation: float = 0.25
    """Minimum correlation of a candidate. Pairs below it are not loops."""
    cohort: PlaceCountOrNone = 24
    """Number of nearest descriptors among the scans that show another place than the query or the match."""
    near_cohort: PlaceCountOrNone = 8
    """Number of nearest descriptors among other scans of the same passes, whose fits may contradict the motion."""
    exact_cohort: PlaceCountOrNone = 6
    exact_near_cohort: PlaceCountOrNone = 3
    """Numbers of these scans, the best by the coarse comparison, whose images are compared exactly."""
    recent_m: Positive = 30.0
    """Minimum travelled distance between a match and its query, in metres. Nearer scans belong to the same pass."""
    beside_m: NotNegative = 10.0
    """Minimum travelled distance from query and match to the scans that show other places, in metres."""
    min_cells: int = 20
    """Minimum number of occupied cells. Images with fewer come from a blocked or failed sensor and are skipped."""
    background_frames: int = 16
    """Number of keyframes in the average image, which is subtracted before comparisons (`loops.background`)."""
    min_background_frames: int = 4
    """Minimum number of keyframes before the average is subtracted."""
    motion: MotionConfig = MotionConfig()

    def __post_init__(self):
        """Raises ValueError if a field has an invalid value."""
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class VerificationConfig:
    """Settings of the comparison of the bird's-eye-view images of two scans."""

    resolution_m: float = RESOLUTION_M
    """Edge of an image's cell, in metres."""
    reach_m: float = 25.0
    """Radius of the compared cells around the sensor, in metres. A circle has the same content at every rotation."""
    max_shift_m: float = 12.0
    """Maximum distance between two scans of one place along x and along y, in metres."""
    turns: int = 72
    """Number of rotations over the whole circle, a multiple of four."""
    coarse: int = 2
    """Number of cells per side that the exhaustive search merges into one."""
    blur_m: float = 0.4
    wide_blur_m: float = 1.0
    """Standard deviations of the two blurs, in metres. The wider blur is subtracted."""
    refine_deg: float = 3.0
    """Range of the refinement to each side, in degrees, in 4 steps."""
    second_m: float = 3.0
    second_deg: float = 15.0
    """Minimum distance of the second peak from the best one, in metres or in degrees."""
    prior_m: float = 2.0
    prior_deg: float = 10.0
    """Maximum distance of a pose from the expected pose, if there is one, in metres and degrees."""

    def __post_init__(self):
        """Raises ValueError if the number of rotations is not a multiple of four."""
        if self.turns < 4 or self.turns % 4:
            raise ValueError(f"expected turns to be a multiple of 4, found {self.turns}")


@dataclasses.dataclass(frozen=True)
class ConsistencyConfig:
    """Thresholds for the consistency of two loops."""

    position_m: float = 0.5
    yaw_deg: float = 1.5
    """Standard deviations of a cycle in addition to the covariances of its loops, in metres and degrees."""
    deviations: float = 3.0
    """Maximum closure error of the cycle of two consistent loops, in standard deviations."""


@dataclasses.dataclass(frozen=True)
class SequenceConfig:
    """Selection and weights of neighbouring pairs."""

    window_m: Positive = 50.0
    """Travelled distance before and after a query within which other queries are its neighbours, in metres."""
    independent_m: Positive = 25.0
    """Travelled distance after which two frames are nearly independent, in metres: the reach of an image."""

    def __post_init__(self):
        """Raises ValueError if a field has an invalid value."""
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class DetectorConfig:
    """Thresholds for accepting a loop closure."""

    min_probability: float = MIN_PROBABILITY
    """Minimum probability of a returned loop, given its neighbours."""
    keyframe_m: float = 0.5
    """Minimum distance of a stored scan from the previous one, in metres. Nearer scans that are turned by less than 20
    degrees are searched for loops, but not stored. 0 stores every scan."""
    max_places: int | None = None
    """Maximum number of stored scans. Beyond it, scans with a loop to a newer stored scan are forgotten first, then the
    oldest. None stores all."""
    candidates: CandidateConfig = CandidateConfig()
    verification: VerificationConfig = VerificationConfig()
    consistency: ConsistencyConfig = ConsistencyConfig()
    sequence: SequenceConfig = SequenceConfig()
    motion_drift: DriftModel = MOTION_DRIFT
    """Drift of the motion that is used if there is no odometry (`loops.motion`)."""
    drift: DriftModel = DriftModel()
    """Drift of the odometry. Loops that contradict it are rejected."""

    def __post_init__(self):
        """Raises ValueError if the probability is outside [0, 1], or if a limit of the stored scans is invalid."""
        _check_probability("min_probability", self.min_probability)
        if not 0 <= self.keyframe_m < math.inf:
            raise ValueError(f"expected keyframe_m of 0 or more, found {self.keyframe_m}")
        if self.max_places is not None and self.max_places < 1:
            raise ValueError(f"expected max_places of 1 or more, found {self.max_places}")


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
