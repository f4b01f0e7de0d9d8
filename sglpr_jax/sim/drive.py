"""Path, times and poses of the sensor, along one of the eleven routes or a pose file, and the sensor's carriers."""

import dataclasses
import hashlib
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from sglpr_jax.data.formats.pose_files import read_kitti, read_times, warn_of_heights
from sglpr_jax.se3 import lengths_along, yaw_of
from sglpr_jax.sim import RATE_HZ
from sglpr_jax.sim.ground import Relief, relief_gradient, relief_height
from sglpr_jax.sim.objects import Range
from sglpr_jax.sim.routes import ROLES, STEP_M, Line, plan_route

PATH_HZ = 10.0  # approximate number of poses per second along the path, of which the scans use some
SHORTEST_S = 60.0  # minimum duration of a drive, in seconds, which allows revisits after 30 s
LANE_M = (0.9, 1.6)  # range of the vehicle's distance to the right of the middle of the street, in metres
SWAY_WAVELENGTH_M = (60.0, 150.0)
STEERING_M = 3.0  # standard deviation of the Gaussian that smooths the path, in metres
LATERAL_ACCELERATION, ACCELERATION = 2.0, 1.5  # maxima in m/s^2, which limit speed in corners and its changes
FREE_SPEED = 1.35  # speed on a free street, as a multiple of the mean speed
TILT_DEG = 0.6  # standard deviation of pitch and of roll relative to the ground, in degrees
TILT_S = 0.5  # approximate duration of a tilt, in seconds

STEPS_HZ = 2.0  # steps of a walking person per second
SHIFT_S = 3.0  # duration of standing before and after a reversal, in seconds
BRAKING_S = 1.0  # standard deviation of the Gaussian that smooths starts and stops, in seconds
REVERSE_SPEED = 0.5  # speed in reverse, as a fraction of the speed forward


class PlanarPath(NamedTuple):
    """Path of the vehicle in the plane, with times."""

    xy: np.ndarray  # (n, 2) position of the LiDAR, metres
    yaw: np.ndarray  # (n,) heading of the vehicle, radians
    times: np.ndarray  # (n,) seconds, from 0

    def retimed(self, old_times: Float[np.ndarray, " m"], times: Float[np.ndarray, " m"]) -> "PlanarPath":
        """Returns the poses of this path at `old_times` as a path with the times `times`, both in seconds."""
        x, y, yaw = (np.interp(old_times, self.times, coordinate) for coordinate in (*self.xy.T, self.yaw))
        return PlanarPath(np.stack([x, y], axis=1), yaw, times)


class TimedPoses(NamedTuple):
    """Poses of the LiDAR and their times."""

    world_from_lidar: np.ndarray  # (n, 4, 4) float64; x forward, y left, z up, metres
    times: np.ndarray  # (n,) seconds


def plan_path(
    rng: np.random.Generator, name: str, *, scans: int, rate_hz: float = RATE_HZ, days: int = 1
) -> PlanarPath:
    """Returns the path along route `name`, with a pose about every 0.1 s, for `scans / rate_hz` seconds or SHORTEST_S.

    The path has `days` equally long parts along the same streets, each with a multiple of `scans` poses.

    Raises:
      ValueError: The route is unknown, or `plan_route` finds no route that is so short.
    """
    if name not in ROLES:
        raise ValueError(f"expected a route among {', '.join(ROLES)}, found {name!r}")
    role = ROLES[name]
    seconds = max(scans / rate_hz, SHORTEST_S)
    middle = plan_route(rng, role, blocks=round(seconds * role.speed_mps / role.block_m), days=days)
    right_m = np.mean(LANE_M) + np.ptp(LANE_M) / 2 * waves(rng, lengths_along(middle), SWAY_WAVELENGTH_M)
    line = gaussian_filter1d(shifted(middle, -right_m), STEERING_M / STEP_M, axis=0, mode="nearest")
    return timed(rng, line, free_mps=FREE_SPEED * role.speed_mps, poses=scans * days)


def timed(rng: np.random.Generator, line: Float[np.ndarray, "n 2"], *, free_mps: float, poses: int) -> PlanarPath:
    """Drive along `line`, at equal time steps of about 0.1 s. The number of poses is a multiple of `poses`.

    `free_mps` is the mean speed on free streets, in m/s.
    """
    heading = np.unwrap(np.arctan2(*np.gradient(line, axis=0).T[::-1]))
    point_times = _times_of_points(rng, line, heading, free_mps)
    times = _even_times(point_times[-1], poses)
    return PlanarPath(line, heading, point_times).retimed(times, times)


def _even_times(end_s: float, poses: int) -> Float[np.ndarray, " n"]:
    """Times about 0.1 s apart up to `end_s`. Their number is a multiple of `poses`."""
    return np.linspace(0, end_s, poses * max(1, round(end_s * PATH_HZ / poses)))


def read_path(file: Path) -> PlanarPath:
    """Reads x, y and yaw of a KITTI pose file. Times come from a `times.txt` beside it, or the lines are 0.1 s apart.

    Raises:
      FileNotFoundError: The file does not exist.
      ValueError: A file is malformed. The message names file and line.
    """
    poses = read_kitti(file)
    if len(poses) < 2:
        raise ValueError(f"{file}: expected 2 poses or more, 12 numbers a line, found {len(poses)}")
    warn_of_heights(poses[:, :3, 3], source=file)
    times_file = file.parent / "times.txt"
    times = read_times(times_file) if times_file.is_file() else None
    times = np.arange(len(poses)) / 10 if times is None else times
    if len(times) != len(poses):
        raise ValueError(f"{times_file}: expected {len(poses)} times, one per pose of {file.name}, found {len(times)}")
    if not np.all(np.diff(times) > 0):
        line = int(np.argmin(np.diff(times))) + 2
        raise ValueError(f"{times_file}, line {line}: expected a time > {times[line - 2]}, found {times[line - 1]}")
    return PlanarPath(poses[:, :2, 3], yaw_of(poses), times - times[0])


def name_of_path(file: Path) -> str:
    """Name of the drive along a pose file: the stem of the file, or the name of its folder for a `poses.txt`."""
    return file.resolve().parent.name if file.name == "poses.txt" else file.stem


def scan_rows(path: PlanarPath, scans: int) -> Int[np.ndarray, " n"]:
    """Indices of every k-th pose of a path, with the smallest k that gives at most `scans` poses."""
    return np.arange(0, len(path.times), -(-len(path.times) // scans))


def check_rate_and_seed(rate_hz: float, seed: int) -> None:
    """Raises ValueError if `rate_hz` is not positive and finite, or if `seed` is negative."""
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise ValueError(f"rate_hz: expected scans per second, more than 0, found {rate_hz}")
    if seed < 0:
        raise ValueError(f"seed: expected a whole number, 0 or more, found {seed}")


def drive_seed(seed: int, name: str) -> tuple[int, int]:
    """Seed of one drive of a dataset: the dataset's seed and a hash of the drive's name."""
    return seed, int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "little")


def poses_on(
    ground: Relief | tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]],
    xy: Float[np.ndarray, "n 2"],
    yaw: Float[np.ndarray, " n"],
    *,
    height_m: float | Float[np.ndarray, " n"],
    tilt: Float[np.ndarray, "n 2"] | None = None,
) -> Float[np.ndarray, "n 4 4"]:
    """Returns world_from_lidar of a vehicle on the ground: x points forward, z along the normal of the ground.

    Arguments:
      ground: Hills, or a pair of height (metres) and slope along x and y of the ground at each pose.
      xy: Position of the LiDAR, in metres.
      yaw: Heading of the vehicle, in radians.
      height_m: Height of the LiDAR above the ground along the normal, one value or one for each pose.
      tilt: Pitch and roll relative to the ground, in radians, see `Carrier.motion`.
    """
    if isinstance(ground, Relief):
        ground = relief_height(ground, xy), relief_gradient(ground, xy)
    ground_height, slope = ground
    forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    x_axis = np.concatenate([forward, (forward * slope).sum(axis=1, keepdims=True)], axis=1)
    z_axis = np.concatenate([-slope, np.ones((len(yaw), 1))], axis=1)
    normal_length = np.linalg.norm(z_axis, axis=1)
    x_axis /= np.linalg.norm(x_axis, axis=1, keepdims=True)
    z_axis /= normal_length[:, None]
    poses = np.tile(np.eye(4), (len(yaw), 1, 1))
    poses[:, :3, :3] = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], axis=2)
    poses[:, :2, 3] = xy
    poses[:, 2, 3] = ground_height + height_m * normal_length  # a distance of `height_m` along the normal
    if tilt is not None:
        poses[:, :3, :3] @= Rotation.from_euler("yx", tilt).as_matrix()
    return poses


def waves(rng: np.random.Generator, length: Float[np.ndarray, " n"], wavelength_m: Range) -> Float[np.ndarray, " n"]:
    """Mean of three random sines of the travelled `length`, in [-1, 1]. `wavelength_m` is the range of wavelengths."""
    wavelengths, phases = rng.uniform(*wavelength_m, 3), rng.uniform(0, 2 * np.pi, 3)
    return np.sin(2 * np.pi * length[:, None] / wavelengths + phases).mean(axis=1)


def shifted(line: Line, left_m: Float[np.ndarray, " n"] | float) -> Line:
    """Shifts `line` to the left by `left_m` metres."""
    direction = np.gradient(line, axis=0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return line + np.reshape(left_m, (-1, 1)) * np.stack([-direction[:, 1], direction[:, 0]], axis=1)


def _times_of_points(
    rng: np.random.Generator, line: Float[np.ndarray, "n 2"], heading: Float[np.ndarray, " n"], free_mps: float
) -> Float[np.ndarray, " n"]:
    """Time of each point of `line`, for the highest speed that streets, corners and a car's acceleration allow."""
    length = lengths_along(line)
    curvature = np.abs(np.gradient(heading, length)).clip(min=1e-6)
    free_speed = free_mps * (1 + 0.2 * waves(rng, length, SWAY_WAVELENGTH_M))
    max_v2 = np.minimum(free_speed**2, LATERAL_ACCELERATION / curvature)  # maximum of the squared speed
    v2_gain = 2 * ACCELERATION * length  # v^2 grows by at most 2 a s
    max_v2 = np.minimum.accumulate(max_v2 - v2_gain) + v2_gain  # after slower points
    max_v2 = np.minimum.accumulate((max_v2 + v2_gain)[::-1])[::-1] - v2_gain  # before slower points
    speed = np.sqrt(max_v2)
    return np.concatenate([[0.0], np.cumsum(np.diff(length) / ((speed[1:] + speed[:-1]) / 2))])


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
    bob_m: float = 0.0  # amplitude of the vertical motion with the steps, in metres
    sway_m: float = 0.0  # amplitude of the motion to the left and right with the steps, in metres
    halt_every_s: Range | None = None
    """Range of the driving time between halts, in seconds. Stands and reversals alternate. None never halts."""
    stand_s: Range = (5.0, 60.0)  # range of the duration of a stand, in seconds
    reverse_m: Range = (5.0, 15.0)  # range of the length of a reversal, in metres

    def motion(
        self, rng: np.random.Generator, times: Float[np.ndarray, " n"], *, height_m: float
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"] | float, Float[np.ndarray, " n"] | float]:
        """Draws the motion of the sensor at `times`, around a mean height of `height_m` metres above the ground.

        Returns:
          Pitch and roll in radians, height above the ground, and distance to the left of the path, in metres.
        """
        if not self.walks:
            return _body_tilt(rng, times) * (self.tilt_deg / TILT_DEG), height_m, 0.0
        swing, bob = _steps(rng, times)
        return np.radians(self.tilt_deg) * swing, height_m + self.bob_m * bob, -self.sway_m * swing[:, 1]

    def halted(self, rng: np.random.Generator, path: PlanarPath, *, poses: int) -> PlanarPath:
        """Inserts the halts into the drive along `path`. The number of poses is a multiple of `poses`."""
        if self.halt_every_s is None:
            return path
        times, path_times = self._knots(rng, path)
        even_times = np.arange(0, times[-1], 1 / PATH_HZ)
        smooth = gaussian_filter1d(np.interp(even_times, times, path_times), BRAKING_S * PATH_HZ, mode="nearest")
        times = _even_times(even_times[-1], poses)
        return path.retimed(np.interp(times, even_times, smooth), times)

    def _knots(self, rng: np.random.Generator, path: PlanarPath) -> tuple[list[float], list[float]]:
        """Draws halts. Returns times of the drive with halts, and times at which `path` is at the same positions."""
        assert self.halt_every_s is not None
        times, path_times, length = [0.0], [0.0], lengths_along(path.xy)

        def add_knot(seconds: float, path_time: float) -> None:
            times.append(times[-1] + seconds)
            path_times.append(path_time)

        reverses, halt_s = rng.random() < 0.5, rng.uniform(*self.halt_every_s)
        while halt_s < path.times[-1]:
            add_knot(halt_s - path_times[-1], halt_s)
            if reverses:
                target_m = np.interp(halt_s, path.times, length) - rng.uniform(*self.reverse_m)
                target_s = float(np.interp(target_m, length, path.times))
                add_knot(SHIFT_S, halt_s)
                add_knot((halt_s - target_s) / REVERSE_SPEED, target_s)
                add_knot(SHIFT_S, target_s)
            else:
                add_knot(rng.uniform(*self.stand_s), halt_s)
            reverses, halt_s = not reverses, halt_s + rng.uniform(*self.halt_every_s)
        add_knot(float(path.times[-1]) - path_times[-1], float(path.times[-1]))
        return times, path_times


VEHICLE = Carrier()
CARRIERS = {
    "vehicle": VEHICLE,
    "backpack": Carrier(
        speed_mps=(1.0, 1.4), rate_hz=2.0, height_m=1.8, walks=True, tilt_deg=5.0, bob_m=0.03, sway_m=0.04
    ),
    "handheld": Carrier(speed_mps=(1.2, 1.2), rate_hz=5.0, height_m=1.4, walks=True, tilt_deg=15.0, bob_m=0.04),
    "cart": Carrier(speed_mps=(0.8, 1.2), height_m=0.6, tilt_deg=0.0),
    "stop-and-reverse": Carrier(halt_every_s=(12.0, 35.0)),
}
"""Carriers by name."""


def _body_tilt(rng: np.random.Generator, times: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    """Draws pitch and roll of the vehicle's body relative to the ground at `times`, in radians."""
    even_times = np.arange(0, times[-1] + 1 / PATH_HZ, 1 / PATH_HZ)
    sigma = TILT_S * PATH_HZ
    noise = gaussian_filter1d(rng.normal(size=(len(even_times), 2)), sigma, axis=0, mode="wrap")
    noise *= np.sqrt(2 * sigma * np.sqrt(np.pi)) * np.radians(TILT_DEG)  # the root undoes the filter's loss of variance
    return np.stack([np.interp(times, even_times, angle) for angle in noise.T], axis=1)


def _steps(
    rng: np.random.Generator, times: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Draws pitch and roll, and height, of a walking person at `times`, as fractions of their amplitudes."""
    phase = np.pi * STEPS_HZ * times[:, None] * rng.uniform(0.97, 1.03, 2)
    sway = np.sin(phase * [2, 1] + rng.uniform(0, 2 * np.pi, 2))  # pitch once every step, roll once every two steps
    drift_period_s = rng.uniform(3, 8, 2)
    drift = np.sin(2 * np.pi * times[:, None] / drift_period_s + rng.uniform(0, 2 * np.pi, 2))
    return 0.6 * sway + 0.4 * drift, np.sin(2 * phase[:, 0])
