"""Elevations of a LiDAR that does not repeat its pattern, as those of Livox.

Elevations follow a low-discrepancy sequence, which fills the field of view evenly in space and, scan after scan, in
time. They are not the curves of the prisms of a real sensor. Field of view and points per scan are the sensor's.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

ScanPattern = Literal["rings", "scattered", "scattered-round"]
"""Pattern of the rays of a scan, see `Sensor.pattern`."""
SCAN_S = 0.1
"""Duration of a scan, in seconds."""
STEPS = 0.6180339887498949, 0.7548776662466927, 0.5698402909980532
"""Steps of the sequence from one azimuth, laser and scan to the next: irrational numbers without a common multiple."""


def scattered(elevations_deg: Sequence[float], azimuths: int, *, time: float) -> Float[np.ndarray, "lasers {azimuths}"]:
    """Elevation of each ray of the scan at `time`, in degrees.

    Arguments:
      elevations_deg: Middle of the band of elevations of each laser. The bands have equal heights and do not overlap.
      azimuths: Number of azimuths.
      time: Time of the scan, in seconds.
    """
    middle = np.array(elevations_deg)
    height = abs(middle[1] - middle[0])
    azimuth, laser, scan = np.arange(azimuths), np.arange(len(middle))[:, None], time / SCAN_S
    part = (azimuth * STEPS[0] + laser * STEPS[1] + scan * STEPS[2]) % 1
    return middle[:, None] + height * (part - 0.5)


def outside_round(
    elevations_deg: Sequence[float], azimuths_deg: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, "lasers n"]:
    """Whether each ray is outside the ellipse of a round field of view."""
    elevation = np.array(elevations_deg)[:, None]
    middle = [(values.max() + values.min()) / 2 for values in (elevation, azimuths_deg)]
    half = [(values.max() - values.min()) / 2 for values in (elevation, azimuths_deg)]
    return ((elevation - middle[0]) / half[0]) ** 2 + ((azimuths_deg - middle[1]) / half[1]) ** 2 > 1
