"""Settings of the registration of bird's-eye-view images, readable without JAX."""

import dataclasses

from sglpr_jax.fields import NotNegative, Positive, Size, check_fields


@dataclasses.dataclass(frozen=True)
class VerificationConfig:
    """Settings of the comparison of the bird's-eye-view images of two scans."""

    reach_m: Positive = 25.0
    """Radius of the compared cells around the sensor, in metres. A circle has the same content at every rotation."""
    max_shift_m: NotNegative = 12.0
    """Maximum distance between two scans of one place along x and along y, in metres."""
    turns: Size = 72
    """Number of compared rotations over the whole circle, a multiple of four."""
    coarse: Size = 2
    """Side of the squares of cells that are averaged into one merged cell for the exhaustive search, in cells."""
    blur_m: NotNegative = 0.4
    """Standard deviation of the narrow blur of the band-pass filter, in metres."""
    wide_blur_m: Positive = 1.0
    """Standard deviation of the wide blur, in metres. The band-pass filter is the narrow blur minus the wide one."""

    def __post_init__(self):
        """Raises ValueError if a field has an invalid value, or if the wide blur is not wider than the narrow one."""
        check_fields(self)
        if self.turns % 4:
            raise ValueError(f"expected turns to be a multiple of 4, found {self.turns}")
        if self.wide_blur_m <= self.blur_m:
            raise ValueError(f"expected wide_blur_m above blur_m ({self.blur_m:g}), found {self.wide_blur_m:g}")
