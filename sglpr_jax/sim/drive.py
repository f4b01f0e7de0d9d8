"""Path and times of the vehicle, along one of the eleven routes or along a given pose file."""

import hashlib
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from sglpr_jax.data.formats.pose_files import read_poses, read_times
from sglpr_jax.se3 import positions_from_camera
from sglpr_jax.sim.choices import RATE_HZ
from sglpr_jax.sim.ground import Relief, relief_gradient, relief_height
from sglpr_jax.sim.routes import ROLES, STEP_M, plan_route, travelled

PATH_HZ = 10.0
"""Approximate number of poses per second along the path. The scans use some of these poses."""
SHORTEST_S = 60.0
"""Minimum duration of a drive, in seconds. It allows revisits after 30 s. Few scans are spread over this time."""
LANE_M = (0.9, 1.6)
"""Range of the vehicle's distance to the right of the middle of the street, in metres.

The paths of both directions are mostly within 3 m of each other.
"""
SWAY_WAVELENGTH_M = (60.0, 150.0)
STEERING_M = 3.0
"""Standard deviation of the Gaussian that smooths the path, in metres. A steering wheel does not jump."""
LATERAL_ACCELERATION = 2.0
ACCELERATION = 1.5
"""Maximum lateral and longitudinal acceleration, in m/s^2. They limit speed in corners and changes of speed."""
FREE_SPEED = 1.35
"""Speed on a free street, as a multiple of the mean speed."""


class PlanarPath(NamedTuple):
    """Path of the vehicle in the plane, with times."""

    xy: np.ndarray  # (n, 2) position of the LiDAR, metres
    yaw: np.ndarray  # (n,) heading of the vehicle, radians
    times: np.ndarray  # (n,) seconds, from 0


class TimedPoses(NamedTuple):
    """Poses of the LiDAR and their times."""

    world_from_lidar: np.ndarray  # (n, 4, 4) float64; x forward, y left, z up, metres
    times: np.ndarray  # (n,) seconds


def plan_scan_path(rng: np.random.Generator, name: str, *, scans: int, rate_hz: float = RATE_HZ) -> PlanarPath:
    """Returns the poses of the `scans` scans of route `name`, evenly spaced in time.

    The drive lasts `scans / rate_hz` seconds, but at least SHORTEST_S. The vehicle keeps right with a small sway that
    differs between visits. It slows down in corners.

    Raises:
      ValueError: The route is unknown.
    """
    return thinned(plan_path(rng, name, scans=scans, rate_hz=rate_hz), scans)


def plan_path(
    rng: np.random.Generator, name: str, *, scans: int, rate_hz: float = RATE_HZ, days: int = 1
) -> PlanarPath:
    """Returns the complete path of `plan_scan_path`, with a pose about every 0.1 s.

    The number of poses is a multiple of `scans * days`. If `days` is above 1, the path has one part for each day. The
    parts are equally long and use the same streets.
    """
    if name not in ROLES:
        raise ValueError(f"expected a route among {', '.join(ROLES)}, found {name!r}")
    role = ROLES[name]
    seconds = max(scans / rate_hz, SHORTEST_S)
    path = _in_lane(rng, plan_route(rng, role, blocks=round(seconds * role.speed_mps / role.block_m), days=days))
    return timed(rng, path, free_mps=FREE_SPEED * role.speed_mps, poses=scans * days)


def timed(rng: np.random.Generator, line: Float[np.ndarray, "n 2"], *, free_mps: float, poses: int) -> PlanarPath:
    """Returns the drive along `line`, with a pose about every 0.1 s. The number of poses is a multiple of `se3`.

    `free_mps` is the mean speed on free streets, in m/s. The vehicle is slower in corners.
    """
    heading = np.unwrap(np.arctan2(*np.gradient(line, axis=0).T[::-1]))
    clock = _clock(rng, line, heading, free_mps)
    times = np.linspace(0, clock[-1], poses * max(1, round(clock[-1] * PATH_HZ / poses)))
    x, y, yaw = (np.interp(times, clock, values) for values in (*line.T, heading))
    return PlanarPath(np.stack([x, y], axis=1), yaw, times)


def read_path(file: Path) -> PlanarPath:
    """Reads the path of a KITTI pose file, with the camera's pose as 12 numbers per line.

    Times come from a `times.txt` in the same folder. Without it, the lines are 0.1 s apart. Distances in x and y are
    those of the file. Height, pitch and roll are dropped.

    Raises:
      FileNotFoundError: The file does not exist.
      ValueError: A file is malformed. The message names file and line, and what was expected and found.
    """
    poses = read_poses(file)
    if len(poses) < 2:
        raise ValueError(f"{file}: expected 2 poses or more, 12 numbers a line, found {len(poses)}")
    times_file = file.parent / "times.txt"
    times = read_times(times_file, unit="s") if times_file.is_file() else None
    times = np.arange(len(poses)) / 10 if times is None else times
    if len(times) != len(poses):
        raise ValueError(f"{times_file}: expected {len(poses)} times, one per pose of {file.name}, found {len(times)}")
    if not np.all(np.diff(times) > 0):
        line = int(np.argmin(np.diff(times))) + 2
        raise ValueError(f"{times_file}, line {line}: expected a time > {times[line - 2]}, found {times[line - 1]}")
    yaw = np.arctan2(-poses[:, 0, 2], poses[:, 2, 2])  # where the camera's z axis points
    return PlanarPath(positions_from_camera(poses)[:, :2], yaw, times - times[0])


def name_of_path(file: Path) -> str:
    """Name of the drive along a pose file: the stem of the file, or the name of its folder for a `se3.txt`."""
    return file.resolve().parent.name if file.name == "poses.txt" else file.stem


def thinned(path: PlanarPath, scans: int) -> PlanarPath:
    """Returns every k-th pose, with the smallest k that gives at most `scans` poses."""
    return PlanarPath(*(values[every_kth(path, scans)] for values in path))


def every_kth(path: PlanarPath, scans: int) -> slice:
    """Indices of the poses that `thinned` keeps."""
    return slice(None, None, -(-len(path.times) // scans))


def speeds(path: PlanarPath) -> Float[np.ndarray, " n"]:
    """Speed of the vehicle at each pose, in m/s. It is negative where the vehicle reverses."""
    velocity = np.gradient(path.xy, path.times, axis=0)
    forward = velocity[:, 0] * np.cos(path.yaw) + velocity[:, 1] * np.sin(path.yaw)
    return np.where(forward < 0, -1, 1) * np.linalg.norm(velocity, axis=1)


def check_drawing(rate_hz: float, seed: int) -> None:
    """Raises ValueError if `rate_hz` is not positive and finite, or if `seed` is negative."""
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise ValueError(f"rate_hz: expected scans per second, more than 0, found {rate_hz}")
    if seed < 0:
        raise ValueError(f"seed: expected a whole number, 0 or more, found {seed}")


def drive_seed(seed: int, name: str) -> tuple[int, int]:
    """Seed of one drive of a dataset. It depends on the name of the drive."""
    return seed, int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "little")


def poses_on(
    relief: Relief,
    xy: Float[np.ndarray, "n 2"],
    yaw: Float[np.ndarray, " n"],
    *,
    height_m: float | Float[np.ndarray, " n"],
    tilt: Float[np.ndarray, "n 2"] | None = None,
) -> Float[np.ndarray, "n 4 4"]:
    """Returns the poses of `poses_over` for a vehicle on hills."""
    ground, slope = relief_height(relief, xy), relief_gradient(relief, xy)
    return poses_over(ground, slope, xy, yaw, height_m=height_m, tilt=tilt)


def poses_over(
    ground: Float[np.ndarray, " n"],
    slope: Float[np.ndarray, "n 2"],
    xy: Float[np.ndarray, "n 2"],
    yaw: Float[np.ndarray, " n"],
    *,
    height_m: float | Float[np.ndarray, " n"],
    tilt: Float[np.ndarray, "n 2"] | None = None,
) -> Float[np.ndarray, "n 4 4"]:
    """Returns world_from_lidar of a vehicle on the ground: x points forward, z along the normal of the ground.

    Arguments:
      ground: Height of the ground, in metres.
      slope: Slope of the ground along x and y.
      xy: Position of the LiDAR, in metres.
      yaw: Heading of the vehicle, in radians.
      height_m: Height of the LiDAR above the ground along the normal, one value or one for each pose.
      tilt: Pitch and roll relative to the ground, in radians, see `Carrier.motion`.
    """
    forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    x_axis = np.concatenate([forward, (forward * slope).sum(axis=1, keepdims=True)], axis=1)
    z_axis = np.concatenate([-slope, np.ones((len(yaw), 1))], axis=1)
    steepness = np.linalg.norm(z_axis, axis=1)
    x_axis /= np.linalg.norm(x_axis, axis=1, keepdims=True)
    z_axis /= steepness[:, None]
    poses = np.tile(np.eye(4), (len(yaw), 1, 1))
    poses[:, :3, :3] = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], axis=2)
    poses[:, :2, 3] = xy
    poses[:, 2, 3] = ground + height_m * steepness  # `height_m` along the normal
    if tilt is not None:
        poses[:, :3, :3] @= Rotation.from_euler("yx", tilt).as_matrix()
    return poses


def _waves(rng: np.random.Generator, length: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Slowly varying random values along a path, between -1 and 1."""
    wavelengths, phases = rng.uniform(*SWAY_WAVELENGTH_M, 3), rng.uniform(0, 2 * np.pi, 3)
    return np.sin(2 * np.pi * length[:, None] / wavelengths + phases).mean(axis=1)


def _in_lane(rng: np.random.Generator, middle: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """`middle` shifted to the right, with a slow sway."""
    offset = np.mean(LANE_M) + np.ptp(LANE_M) / 2 * _waves(rng, travelled(middle))
    tangent = np.gradient(middle, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    lane = middle + offset[:, None] * np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    return gaussian_filter1d(lane, STEERING_M / STEP_M, axis=0, mode="nearest")


def _clock(
    rng: np.random.Generator, path: Float[np.ndarray, "n 2"], heading: Float[np.ndarray, " n"], free_mps: float
) -> Float[np.ndarray, " n"]:
    """Time of each point of `path`, for the highest speed that streets, corners and a car's acceleration allow."""
    length = travelled(path)
    curvature = np.abs(np.gradient(heading, length)).clip(min=1e-6)
    limit = np.minimum((free_mps * (1 + 0.2 * _waves(rng, length))) ** 2, LATERAL_ACCELERATION / curvature)
    gain = 2 * ACCELERATION * length  # v^2 grows by at most 2 a s
    limit = np.minimum.accumulate(limit - gain) + gain
    limit = np.minimum.accumulate((limit + gain)[::-1])[::-1] - gain
    speed = np.sqrt(limit)
    return np.concatenate([[0.0], np.cumsum(np.diff(length) / ((speed[1:] + speed[:-1]) / 2))])
