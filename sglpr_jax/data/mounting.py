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
"""Minimum tilt of a mounting, in degrees. Smaller tilts come from the slope of the road or the suspension and are
ignored."""
NEAR_M = (0.8, 25.0)
"""Range of distances from the sensor at which the ground is searched, in metres."""
VOXEL_M = 0.4
"""Edge of a voxel, in metres. One point per voxel is used, because most points lie on the nearest metres of ground."""
THICK_M = 0.12
"""Maximum distance of a ground point from the plane, in metres."""
MOST_BELOW = 0.1
"""Maximum fraction of points below the ground, such as reflections and descending slopes."""
LEAST_SHARE = 0.05
LEAST_POINTS = 40
"""Minimum fraction (`LEAST_SHARE`) and number of points on the ground."""
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

    @property
    def upright_from_lidar(self) -> Float[np.ndarray, "3 3"]:
        """Smallest rotation that maps up to z. For an upside-down sensor, a half rotation about x comes first."""
        half = np.diag([1.0, -1.0, -1.0]) if self.up[2] < 0 else np.eye(3)
        x, y, z = half @ np.array(self.up)
        cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
        return (np.eye(3) + cross + cross @ cross / (1 + z)) @ half

    def level(self, points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
        """Transform points (n, 3) to the frame of a gravity-aligned sensor at `MODEL_HEIGHT_M`. NaN stays NaN."""
        if self.up == (0.0, 0.0, 1.0):
            lifted = points.copy(order="K")
            lifted[:, 2] += np.float32(self.height_m - MODEL_HEIGHT_M)
            return lifted
        with np.errstate(invalid="ignore"):
            turned = points.astype(np.float64) @ self.upright_from_lidar.T
        return (turned + np.array([0, 0, self.height_m - MODEL_HEIGHT_M])).astype(np.float32)

    def scaled(self, scale: Scale) -> "Mounting":
        """The same mounting with its height and the deviation of the height multiplied by `scale`."""
        deviation = None if self.height_deviation_m is None else scale * self.height_deviation_m
        return replace(self, height_m=scale * self.height_m, height_deviation_m=deviation)

    def __str__(self) -> str:
        hangs = self.up[2] < 0
        tilt = 180 - self.tilt_deg if hangs else self.tilt_deg
        parts = [f"{self.height_m:.2f} m above the ground", *(["upside down"] if hangs else [])]
        return ", ".join([*parts, *([f"tilted by {tilt:.0f} degrees"] if tilt >= LEVEL_DEG else [])])


def estimate_mounting(points: Float32[np.ndarray, "n 3"], *, near: Mounting | None = None) -> Mounting | None:
    """Estimate the mounting of a sensor from the ground in one scan, or None if no ground is found.

    RANSAC searches for the plane with the most points and almost no points below it, and least squares refine it. The
    plane may be tilted by up to 35 degrees against the sensor's z axis, and the sensor may hang upside down. The result
    is deterministic.

    Arguments:
      points: Points in the LiDAR frame, in metres.
      near: Mounting of other scans of the sensor. The ground is searched on the same side of the sensor, with fewer
        trials.

    Example:
      mounting = estimate_mounting(recording.points(0))
    """
    cloud = _thinned(points)
    cloud = cloud[:: len(cloud) // MOST_POINTS + 1]
    few = cloud if near is None else cloud[:: len(cloud) // NEAR_POINTS + 1]
    if len(few) < LEAST_POINTS:
        return None
    normals, heights = _planes(few, trials=TRIALS if near is None else NEAR_TRIALS)
    if near is not None:
        same_side = normals @ np.array(near.up) > 0
        normals, heights = normals[same_side], heights[same_side]
    if not len(heights):
        return None
    distances = few @ normals.T + heights
    ground = np.abs(distances) < THICK_M
    score = np.where((distances < -2 * THICK_M).mean(axis=0) <= MOST_BELOW, ground.sum(axis=0), 0)
    score = np.where(normals[:, 2] > 0, UPSIDE_DOWN * score, score)
    best = int(np.argmax(score))
    if score[best] == 0:
        return None
    on_plane = ground[:, best] if near is None else np.abs(cloud @ normals[best] + heights[best]) < THICK_M
    return _fitted(cloud, on_plane, normals[best])


def common_mounting(found: Iterable[Mounting | None]) -> Mounting | None:
    """Median of the mountings that were estimated from the scans of a recording. A tilt below 2 degrees is set to zero.

    Only the side of the ground that most scans show counts. Returns None if fewer than half of the scans have a
    mounting, or without a majority.
    """
    scans = list(found)
    hanging = [one for one in scans if one is not None and one.up[2] < 0]
    upright = [one for one in scans if one is not None and one.up[2] >= 0]
    agreed = max(hanging, upright, key=len)
    if 2 * len(hanging + upright) < len(scans) or len(hanging) == len(upright):
        return None
    height = float(np.median([mounting.height_m for mounting in agreed]))
    up = np.median([mounting.up for mounting in agreed], axis=0)
    mounting = Mounting(height, _unit(up))
    if min(mounting.tilt_deg, 180 - mounting.tilt_deg) < LEVEL_DEG:
        return Mounting(height, (0.0, 0.0, float(np.sign(up[2]))))
    return mounting


def _thinned(points: Float32[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return the first point of each voxel near the sensor."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = points.T.astype(np.float64)
        distance = np.sqrt(x * x + y * y + z * z)  # NaN and infinity fail the next test.
        near = points[(distance > NEAR_M[0]) & (distance < NEAR_M[1])].astype(np.float64)
    if not len(near):
        return near
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
    kept = np.abs(normals[:, 2]) > np.maximum(np.cos(np.radians(STEEPEST_DEG)) * lengths, 0.5)
    normals = (normals / np.copysign(np.maximum(lengths, 1e-9), normals[:, 2])[:, None])[kept]
    heights = -np.einsum("ti,ti->t", normals, a[kept])
    normals, heights = np.concatenate([normals, -normals]), np.concatenate([heights, -heights])  # either side may be up
    kept = (heights >= np.where(normals[:, 2] > 0, HEIGHTS_M[0], LEAST_HANGING_M)) & (heights <= HEIGHTS_M[1])
    return normals[kept], heights[kept]


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
