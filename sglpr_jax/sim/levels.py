"""Storeys above one another. The world holds them side by side, because its ground has one height at each position."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Line = Float[np.ndarray, "n 2"]


class Unfolded(NamedTuple):
    """Path through storeys."""

    xy: np.ndarray  # (n, 2) positions in the world that holds the storeys side by side, metres
    ground: np.ndarray  # (n,) true height of the ground, metres
    slope: np.ndarray  # (n, 2) true slope of the ground along x and y


@dataclasses.dataclass(frozen=True)
class Levels:
    """Equal storeys above one another, joined by ramps above one another that descend along x.

    In the world, storey k is shifted by k * `pitch_m` along y. The world of each storey has a level copy of the ramp.
    In the middle of the ramp, a path changes from one storey to the next. A scan on a ramp therefore shows a level ramp
    that is parallel to the sensor. Its true pose follows the slope, whose change over 1 m is at most about 1.5 degrees.
    """

    rise_m: float
    """Height of a storey, in metres."""
    pitch_m: float
    """Distance of two storeys along y in the world, in metres."""
    ramp_y_m: float
    """Minimum y of paths on the ramps, in metres. Paths with smaller y are on a storey."""
    top_m: float
    """x of the top of the ramps, in metres."""
    foot_m: float
    """x of the foot of the ramps, in metres, above `top_m`."""

    def along(self, path: Line) -> Unfolded:
        """Returns the unfolded path of a path that begins on the lowest storey.

        The points of the path must be close enough to find each crossing of the middle of a ramp.
        """
        on, beyond = path[:, 1] > self.ramp_y_m, path[:, 0] < (self.top_m + self.foot_m) / 2
        storey = np.concatenate([[0], np.cumsum(np.diff(beyond.astype(int)) * on[1:])])
        run = self.foot_m - self.top_m
        share = ((self.foot_m - path[:, 0]) / run).clip(0, 1)
        climbed = np.where(on, share**2 * (3 - 2 * share) - beyond, 0)
        steepness = np.where(on, 6 * share * (1 - share), 0) * self.rise_m / run
        slope = np.stack([-steepness, np.zeros(len(path))], axis=1)
        there = path + self.pitch_m * np.stack([np.zeros(len(path)), storey], axis=1)
        return Unfolded(there, self.rise_m * (storey + climbed), slope)
