"""Settings of the registration of bird's-eye-view images, readable without JAX."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class VerificationConfig:
    """Settings of the comparison of the bird's-eye-view images of two scans."""

    reach_m: float = 25.0
    """Radius of the compared cells around the sensor, in metres. A circle has the same content at every rotation."""
    max_shift_m: float = 12.0
    """Maximum distance between two scans of one place along x and along y, in metres."""
    turns: int = 72
    """Number of compared rotations over the whole circle, a multiple of four."""
    coarse: int = 2
    """Side of the squares of cells that are averaged into one merged cell for the exhaustive search, in cells."""
    blur_m: float = 0.4
    """Standard deviation of the narrow blur of the band-pass filter, in metres."""
    wide_blur_m: float = 1.0
    """Standard deviation of the wide blur, in metres. The band-pass filter is the narrow blur minus the wide one."""

    def __post_init__(self):
        """Raises ValueError if the number of rotations is not a multiple of four."""
        if self.turns < 4 or self.turns % 4:
            raise ValueError(f"expected turns to be a multiple of 4, found {self.turns}")
