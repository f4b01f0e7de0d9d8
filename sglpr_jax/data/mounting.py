"""Mounting of a sensor: its height above the ground and the direction of up, and their estimation from the ground.

A density image omits points more than 1.2 m below the sensor, which suits a sensor 1.73 m above a road. Points of other
sensors are rotated to be gravity-aligned and shifted to this height.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32

from sglpr_jax.data.choices import Scale

MODEL_HEIGHT_M = 1.73
"""Sensor height that all shipped weights assume, in metres: that of KITTI's Velodyne and of the simulator."""
HEIGHTS_M = (-0.5, 4.5)
"""Range of possible sensor heights, in metres: from points in the vehicle's own frame to the roof of a lorry."""
LEAST_HANGING_M = 0.2
"""Minimum height of an upside-down sensor, in metres."""
STEEPEST_DEG = 35.0
"""Maximum angle between the sensor's z axis and up, or down, in degrees."""
LEVEL_DEG = 2.0
"""Minimum tilt of a mounting, in degrees. Smaller tilts come from the slope of the road or the suspension."""
NEAR_M = (0.8, 25.0)
"""Range of distances from the sensor at which the ground is searched, in metres."""
VOXEL_M = 0.4
"""Edge of a voxel, in metres. One point per voxel is used, because most points lie on the nearest metres of ground."""
THICK_M = 0.12
"""Maximum distance of a ground point from the plane, in metres."""
MOST_BELOW = 0.1
"""Maximum fraction of points below the ground, such as reflections and descending slopes."""
LEAST_SHARE, LEAST_POINTS = 0.05, 40
"""Minimum fraction and number of points on the ground."""
MOST_POINTS = 6000
"""Maximum number of points for the search. Larger clouds are subsampled."""
TRIALS = 400
"""Number of point triples that RANSAC samples."""
NEAR_TRIALS, NEAR_POINTS = 150, 2000
"""Number of point triples, and of points that they are compared with, if the mounting is known approximately."""
UPSIDE_DOWN = 2.0
"""Minimum ratio of ground points above a sensor to those below if it hangs upside down. It exceeds 1 because rooms have
ceilings."""


@dataclass(frozen=True)
class Mounting:
    """Height of a sensor above the ground, and the direction of up in the sensor frame."""

    height_m: float
    """Height above the ground, in metres."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction of up in the sensor frame, a unit vector."""
    height_deviation_m: float | None = None
    tilt_deviation_deg: float | None = None
    """Standard deviation of the height in metres, and of up about each horizontal axis in degrees. None for a sensor
    that is fixed to a vehicle."""

    def __post_init__(self):
        if not (math.isfinite(self.height_m) and -1 < self.height_m < 100):
            raise ValueError(f"expected the sensor's height above the ground in metres, found {self.height_m}")

    @property
    def fields(self) -> dict[str, Any]:
        """Values that are known, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @property
    def tilt_deg(self) -> float:
        """Angle between the sensor's z axis and up, in degrees. It is 180 for an upside-down sensor."""
        return math.degrees(math.acos(min(1.0, max(-1.0, self.up[2]))))

    def level(self, points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
        """Transform points (n, 3) to the frame of a gravity-aligned sensor at `MODEL_HEIGHT_M`. NaN stays NaN."""
        if self.up == (0.0, 0.0, 1.0):
            lifted = points.copy(order="K")
            lifted[:, 2] += np.float32(self.height_m - MODEL_HEIGHT_M)
            return lifted
        transform = upright_from_lidar(self)
        with np.errstate(invalid="ignore"):
            return (points.astype(np.float64) @ transform[:3, :3].T + transform[:3, 3]).astype(np.float32)

    def scaled(self, scale: Scale) -> "Mounting":
        """The same mounting with its height and the deviation of the height multiplied by `scale`."""
        deviation = None if self.height_deviation_m is None else scale * self.height_deviation_m
        return replace(self, height_m=scale * self.height_m, height_deviation_m=deviation)

    def __str__(self) -> str:
        hangs = self.up[2] < 0
        tilt = 180 - self.tilt_deg if hangs else self.tilt_deg
        parts = [f"{self.height_m:.2f} m above the ground", *(["upside down"] if hangs else [])]
        return ", ".join([*parts, *([f"tilted by {tilt:.0f} degrees"] if tilt >= LEVEL_DEG else [])])


def upright_from_lidar(mounting: Mounting | None) -> Float[np.ndarray, "4 4"]:
    """Transform from the LiDAR frame to the gravity-aligned frame at `MODEL_HEIGHT_M`, the identity for None.

    The rotation is the smallest one that maps up to z. For an upside-down sensor, a half rotation about x comes first.
    """
    transform = np.eye(4)
    if mounting is None:
        return transform
    half = np.diag([1.0, -1.0, -1.0]) if mounting.up[2] < 0 else np.eye(3)
    x, y, z = half @ np.array(mounting.up)
    cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
    transform[:3, :3] = (np.eye(3) + cross + cross @ cross / (1 + z)) @ half
    transform[2, 3] = mounting.height_m - MODEL_HEIGHT_M
    return transform


def is_tilted(upright_from_lidar: Float[np.ndarray, "*n 4 4"]) -> bool:
    """Return whether the z axis of a sensor does not point up, in any of the transforms."""
    return bool((upright_from_lidar[..., 2, :3] != [0.0, 0.0, 1.0]).any())


def estimate_mounting(points: Float32[np.ndarray, "n 3"], *, near: Mounting | None = None) -> Mounting | None:
    """Estimate the mounting of a sensor from the ground in one scan. Returns None without ground.

    RANSAC, with a fixed seed, searches for the plane with the most points and almost no points below it, and least
    squares refine it. The plane is tilted by at most 35 degrees, and the sensor may hang upside down.

    Arguments:
      points: Points in the LiDAR frame, in metres.
      near: Mounting at other scans. The ground is searched on the same side of the sensor, with fewer trials.

    Example:
      mounting = estimate_mounting(recording.points(0))
    """
    cloud = _thinned(points)
    cloud = cloud[:: len(cloud) // MOST_POINTS + 1]
    sample = cloud if near is None else cloud[:: len(cloud) // NEAR_POINTS + 1]
    if len(sample) < LEAST_POINTS:
        return None
    normals, heights = _planes(sample, trials=TRIALS if near is None else NEAR_TRIALS)
    if near is not None:
        same_side = normals @ np.array(near.up) > 0
        normals, heights = normals[same_side], heights[same_side]
    distances = sample @ normals.T + heights
    ground = np.abs(distances) < THICK_M
    score = np.where((distances < -2 * THICK_M).mean(axis=0) <= MOST_BELOW, ground.sum(axis=0), 0)
    score = np.where(normals[:, 2] > 0, UPSIDE_DOWN * score, score)
    if not score.any():
        return None
    best = int(np.argmax(score))
    on_plane = ground[:, best] if near is None else np.abs(cloud @ normals[best] + heights[best]) < THICK_M
    return _fitted(cloud, on_plane, normals[best])


def common_mounting(mountings: Iterable[Mounting | None]) -> Mounting | None:
    """Median of the mountings estimated from scans of a recording. A tilt below 2 degrees is set to zero.

    Only the side of the ground that most scans show counts. Returns None if fewer than half of the scans have a
    mounting, or without a majority.
    """
    scans = list(mountings)
    hanging = [mounting for mounting in scans if mounting is not None and mounting.up[2] < 0]
    upright = [mounting for mounting in scans if mounting is not None and mounting.up[2] >= 0]
    majority = max(hanging, upright, key=len)
    if 2 * len(hanging + upright) < len(scans) or len(hanging) == len(upright):
        return None
    height = float(np.median([mounting.height_m for mounting in majority]))
    up = np.median([mounting.up for mounting in majority], axis=0)
    common = Mounting(height, _unit(up))
    if min(common.tilt_deg, 180 - common.tilt_deg) < LEVEL_DEG:
        return Mounting(height, (0.0, 0.0, float(np.sign(up[2]))))
    return common


def _thinned(points: Float32[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return the first point of each voxel near the sensor."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = points.T.astype(np.float64)
        distance = np.sqrt(x * x + y * y + z * z)  # NaN and infinity fail the next test.
        near = points[(distance > NEAR_M[0]) & (distance < NEAR_M[1])].astype(np.float64)
    x, y, z = np.floor(near.T / VOXEL_M).astype(np.int64) + 128
    _, first = np.unique((z * 256 + y) * 256 + x, return_index=True)
    return near[np.sort(first)]


def _planes(
    points: Float[np.ndarray, "n 3"], *, trials: int
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, " t"]]:
    """Sample planes that may be the ground. Returns normals that point up, and heights of the sensor above them."""
    rng = np.random.default_rng(0)
    first = rng.integers(len(points), size=trials)
    near = rng.normal(scale=len(points) / 8, size=(2, trials)).astype(int) + first  # often neighbours in the file
    a, b, c = (points[index % len(points)] for index in (first, *near))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    flat = np.abs(normals[:, 2]) > np.maximum(np.cos(np.radians(STEEPEST_DEG)) * lengths, 0.5)
    normals = (normals / np.copysign(np.maximum(lengths, 1e-9), normals[:, 2])[:, None])[flat]
    heights = -np.einsum("ti,ti->t", normals, a[flat])
    normals, heights = np.concatenate([normals, -normals]), np.concatenate([heights, -heights])  # either side may be up
    possible = (heights >= np.where(normals[:, 2] > 0, HEIGHTS_M[0], LEAST_HANGING_M)) & (heights <= HEIGHTS_M[1])
    return normals[possible], heights[possible]


def _fitted(
    points: Float[np.ndarray, "n 3"], ground: Bool[np.ndarray, " n"], up: Float[np.ndarray, "3"]
) -> Mounting | None:
    """Fit a plane to the ground points by least squares and select the ground points again, four times."""
    normal, centre = up, np.zeros(3)
    for _ in range(4):
        if ground.sum() < LEAST_POINTS or ground.mean() < LEAST_SHARE:
            return None
        centre = points[ground].mean(axis=0)
        normal = np.linalg.svd(points[ground] - centre, full_matrices=False)[2][2]
        normal = normal * np.sign(normal @ up)
        ground = np.abs((points - centre) @ normal) < THICK_M
    height = float(-normal @ centre)
    tilted = abs(normal[2]) < np.cos(np.radians(STEEPEST_DEG))
    return None if tilted or not HEIGHTS_M[0] <= height <= HEIGHTS_M[1] else Mounting(height, _unit(normal))


def _unit(vector: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = (vector / np.linalg.norm(vector)).tolist()
    return x, y, z
