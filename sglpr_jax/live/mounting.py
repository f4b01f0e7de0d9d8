"""Mounting of the sensor of a live map, from its first scans."""

import numpy as np
from jaxtyping import Float32

from sglpr_jax.data.choices import SensorHeight
from sglpr_jax.data.mounting import Mounting, common_mounting, estimate_mounting

SCANS = 11
"""Number of scans from which the mounting is estimated."""


class FirstScans:
    """Estimates the mounting from the ground in the first scans. Then it is fixed."""

    def __init__(self, height: SensorHeight = "auto", *, known: Mounting | None = None):
        """Begin with the height that the user gave, in metres, or with the mounting of an earlier process."""
        given = None if isinstance(height, str) else Mounting(float(height))
        self.mounting = known or given
        """Mounting found by now, or None if the scans do not show the ground."""
        self._fixed = self.mounting is not None
        self._found: list[Mounting | None] = []

    def see(self, points: Float32[np.ndarray, "n 3"]) -> Mounting | None:
        """Return the mounting at the next scan."""
        if not self._fixed:
            self._found.append(estimate_mounting(points))
            self.mounting = common_mounting(self._found)
            self._fixed = len(self._found) >= SCANS
        return self.mounting
