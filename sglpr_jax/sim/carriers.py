"""Carriers of the sensor: vehicles and people, with their speed, height, sway, and stops."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from sglpr_jax.sim.drive import PATH_HZ, PlanarPath
from sglpr_jax.sim.routes import travelled
from sglpr_jax.sim.things import Range

TILT_DEG = 0.6
"""Standard deviation of pitch and of roll relative to the ground, in degrees, due to springs, bumps and rough roads."""
TILT_S = 0.5
"""Approximate duration of a tilt, in seconds."""
HAND_HEIGHT_M, HAND_BOB_M = 1.4, 0.04
"""Mean height of a hand-held sensor above the ground, and amplitude of its vertical motion, in metres."""
HAND_TILT_DEG = 15.0
"""Maximum pitch and roll of a hand-held sensor, in degrees."""
STEPS_HZ = 2.0
"""Steps of a walking person per second."""
SHIFT_S = 3.0
"""Duration of standing before and after a reversal, in seconds."""
BRAKING_S = 1.0
"""Standard deviation of the Gaussian that smooths starts and stops, in seconds."""
REVERSE_SPEED = 0.5
"""Speed in reverse, as a fraction of the speed forward."""


class Motion(NamedTuple):
    """Motion of the sensor relative to the ground below the path."""

    tilt: np.ndarray  # (n, 2) pitch and roll, radians
    height: np.ndarray | float  # (n,) or one value for all, metres above the ground
    left: np.ndarray | float  # (n,) or one value for all, metres to the left of the path


@dataclasses.dataclass(frozen=True)
class Carrier:
    """Vehicle or person that carries the sensor."""

    speed_mps: Range | None = None
    """Range of the speed, in m/s. None uses the speed of the scenery."""
    rate_hz: float | None = None
    """Scans per second. None uses the rate of the scenery."""
    height_m: float | None = None
    """Mean height of the sensor above the ground, in metres. None uses the height of the scenery or of the sensor."""
    walks: bool = False
    """Whether the sensor sways with the steps of a person. Otherwise it tilts like the body of a car."""
    tilt_deg: float = TILT_DEG
    """Standard deviation of pitch and roll, in degrees. With `walks`, their maximum."""
    bob_m: float = 0.0
    """Amplitude of the vertical motion with the steps, in metres."""
    sway_m: float = 0.0
    """Amplitude of the motion to the left and right with the steps, in metres."""
    halt_every_s: Range | None = None
    """Range of the driving time between two halts, in seconds. A halt is a stand or, every second time, a reversal.

    None never halts.
    """
    stand_s: Range = (5.0, 60.0)
    """Range of the duration of a stand, in seconds."""
    reverse_m: Range = (5.0, 15.0)
    """Range of the length of a reversal, in metres."""

    def motion(self, rng: np.random.Generator, times: Float[np.ndarray, " n"], *, height_m: float) -> Motion:
        """Draws the motion of the sensor at `times`. Its mean height is `height_m` if the carrier has no height."""
        height_m = height_m if self.height_m is None else self.height_m
        if not self.walks:
            return Motion(body_tilt(rng, times) * (self.tilt_deg / TILT_DEG), height_m, 0.0)
        swing, bob = steps(rng, times)
        return Motion(np.radians(self.tilt_deg) * swing, height_m + self.bob_m * bob, -self.sway_m * swing[:, 1])

    def halted(self, rng: np.random.Generator, path: PlanarPath, *, poses: int) -> PlanarPath:
        """Inserts the halts into the drive along `path`, which must not stand.

        The number of poses is a multiple of `se3`. The heading stays that of the path where the carrier reverses.
        """
        if self.halt_every_s is None:
            return path
        clock, progress = self._halts(rng, path)
        even = np.arange(0, clock[-1], 1 / PATH_HZ)
        smooth = gaussian_filter1d(np.interp(even, clock, progress), BRAKING_S * PATH_HZ, mode="nearest")
        times = np.linspace(0, even[-1], poses * max(1, round(even[-1] * PATH_HZ / poses)))
        at = np.interp(times, even, smooth)
        x, y, yaw = (np.interp(at, path.times, values) for values in (*path.xy.T, path.yaw))
        return PlanarPath(np.stack([x, y], axis=1), yaw, times)

    def _halts(self, rng: np.random.Generator, path: PlanarPath) -> tuple[list[float], list[float]]:
        """Knots of the drive with halts: times, and the times at which `path` is at the same places."""
        assert self.halt_every_s is not None
        clock, progress, length = [0.0], [0.0], travelled(path.xy)

        def go(seconds: float, to: float) -> None:
            clock.append(clock[-1] + seconds)
            progress.append(to)

        reverses, there = rng.random() < 0.5, rng.uniform(*self.halt_every_s)
        while there < path.times[-1]:
            go(there - progress[-1], there)
            if reverses:
                metres = np.interp(there, path.times, length) - rng.uniform(*self.reverse_m)
                back = float(np.interp(metres, length, path.times))
                go(SHIFT_S, there)
                go((there - back) / REVERSE_SPEED, back)
                go(SHIFT_S, back)
            else:
                go(rng.uniform(*self.stand_s), there)
            reverses, there = not reverses, there + rng.uniform(*self.halt_every_s)
        go(float(path.times[-1]) - progress[-1], float(path.times[-1]))
        return clock, progress


VEHICLE = Carrier()
HANDHELD = Carrier(
    speed_mps=(1.2, 1.2), rate_hz=5.0, height_m=HAND_HEIGHT_M, walks=True, tilt_deg=HAND_TILT_DEG, bob_m=HAND_BOB_M
)
CARRIERS = {
    "vehicle": VEHICLE,
    "backpack": Carrier(
        speed_mps=(1.0, 1.4), rate_hz=2.0, height_m=1.8, walks=True, tilt_deg=5.0, bob_m=0.03, sway_m=0.04
    ),
    "handheld": HANDHELD,
    "cart": Carrier(speed_mps=(0.8, 1.2), height_m=0.6, tilt_deg=0.0),
    "stop-and-reverse": Carrier(halt_every_s=(12.0, 35.0)),
}
"""Carriers by name."""


def body_tilt(rng: np.random.Generator, times: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    """Draws pitch and roll of the vehicle's body relative to the ground at `times`, in radians."""
    steps = np.arange(0, times[-1] + 1 / PATH_HZ, 1 / PATH_HZ)
    width = TILT_S * PATH_HZ
    noise = gaussian_filter1d(rng.normal(size=(len(steps), 2)), width, axis=0, mode="wrap")
    noise *= np.sqrt(2 * width * np.sqrt(np.pi)) * np.radians(TILT_DEG)  # undoes the loss of variance in the filter
    return np.stack([np.interp(times, steps, axis) for axis in noise.T], axis=1)


def steps(
    rng: np.random.Generator, times: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Draws the motion of a walking person at `times`, as fractions of its amplitudes, between -1 and 1.

    Pitch and roll oscillate with the steps, around directions that change over some seconds.

    Returns:
      Pitch and roll, and height.
    """
    phase = np.pi * STEPS_HZ * times[:, None] * rng.uniform(0.97, 1.03, 2)  # the body sways once every two steps
    sway = np.sin(phase * [2, 1] + rng.uniform(0, 2 * np.pi, 2))
    seconds = rng.uniform(3, 8, 2)
    drift = np.sin(2 * np.pi * times[:, None] / seconds + rng.uniform(0, 2 * np.pi, 2))
    return 0.6 * sway + 0.4 * drift, np.sin(2 * phase[:, 0])
