"""Settings of the registration of bird's-eye-view images, readable without JAX."""

import dataclasses

from sglpr_jax.grid import DENSITY_RESOLUTION_M


@dataclasses.dataclass(frozen=True)
class VerificationConfig:
    """Settings of the comparison of the bird's-eye-view images of two scans."""

    resolution_m: float = DENSITY_RESOLUTION_M
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
