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
from sglpr_jax.voxels import one_per_voxel

MODEL_HEIGHT_M = 1.73
"""Sensor height that all shipped weights assume, in metres: that of KITTI's Velodyne and of the simulator."""
HEIGHTS_M = (-0.5, 4.5)
"""Range of possible sensor heights, in metres: from the origin of a vehicle's frame to the roof of a lorry."""
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
"""Number of point triples that RANSAC samples if nothing is known about the mounting."""
NEAR_TRIALS, NEAR_POINTS = 150, 2000
"""Numbers of point triples and of points in RANSAC if the mounting is approximately known."""
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
        """All fields that are not None, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @property
    def tilt_deg(self) -> float:
        """Angle between the sensor's z axis and up, in degrees. It is 180 for an upside-down sensor."""
        return math.degrees(math.acos(min(1.0, max(-1.0, self.up[2]))))

    def level(self, points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
        """Transform points (n, 3) to the frame of a gravity-aligned sensor at `MODEL_HEIGHT_M`. NaN stays NaN."""
        if self.up == (0.0, 0.0, 1.0):
            raised = points.copy(order="K")
            raised[:, 2] += np.float32(self.height_m - MODEL_HEIGHT_M)
            return raised
        transform = upright_from_lidar(self)
        with np.errstate(invalid="ignore"):
            return (points.astype(np.float64) @ transform[:3, :3].T + transform[:3, 3]).astype(np.float32)

    def scaled(self, scale: Scale) -> "Mounting":
        """Return the mounting with its height and the standard deviation of the height multiplied by `scale`."""
        deviation = None if self.height_deviation_m is None else scale * self.height_deviation_m
        return replace(self, height_m=scale * self.height_m, height_deviation_m=deviation)

    def __str__(self) -> str:
        is_upside_down = self.up[2] < 0
        tilt_deg = 180 - self.tilt_deg if is_upside_down else self.tilt_deg
        text = f"{self.height_m:.2f} m above the ground"
        text += ", upside down" if is_upside_down else ""
        return text + (f", tilted by {tilt_deg:.0f} degrees" if tilt_deg >= LEVEL_DEG else "")


def upright_from_lidar(mounting: Mounting | None) -> Float[np.ndarray, "4 4"]:
    """Transform from the LiDAR frame to the gravity-aligned frame at `MODEL_HEIGHT_M`, the identity for None.

    The rotation is the smallest one that maps up to z. For an upside-down sensor, a half rotation about x comes first.
    """
    transform = np.eye(4)
    if mounting is None:
        return transform
    half_turn = np.diag([1.0, -1.0, -1.0]) if mounting.up[2] < 0 else np.eye(3)
    x, y, z = half_turn @ np.array(mounting.up)
    cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])  # Rodrigues' formula for the rotation from (x, y, z) to z
    transform[:3, :3] = (np.eye(3) + cross + cross @ cross / (1 + z)) @ half_turn
    transform[2, 3] = mounting.height_m - MODEL_HEIGHT_M
    return transform


def is_tilted(upright_from_lidar: Float[np.ndarray, "*n 4 4"]) -> bool:
    """Return whether any of the transforms tilts its sensor: up is not exactly the z axis of the LiDAR frame."""
    return bool((upright_from_lidar[..., 2, :3] != [0.0, 0.0, 1.0]).any())


def estimate_mounting(points: Float32[np.ndarray, "n 3"], *, near: Mounting | None = None) -> Mounting | None:
    """Estimate the mounting of a sensor from the ground in one scan. Returns None if no ground is found.

    RANSAC, with a fixed seed, searches for the plane with the most points and almost no points below it, and least
    squares refine it. The plane is tilted by at most 35 degrees, and the sensor may hang upside down.

    Arguments:
      points: Points in the LiDAR frame, in metres.
      near: Mounting at other scans. The ground is searched on the same side of the sensor, with fewer trials.

    Example:
      mounting = estimate_mounting(recording.points(0))
    """
    cloud = _near_points(points)
    cloud = cloud[:: len(cloud) // MOST_POINTS + 1]
    sample = cloud if near is None else cloud[:: len(cloud) // NEAR_POINTS + 1]
    if len(sample) < LEAST_POINTS:
        return None
    normals, heights = _sampled_planes(sample, trials=TRIALS if near is None else NEAR_TRIALS)
    if near is not None:
        is_same_side = normals @ np.array(near.up) > 0
        normals, heights = normals[is_same_side], heights[is_same_side]
    distances_m = sample @ normals.T + heights  # of each point above each plane
    is_on_plane = np.abs(distances_m) < THICK_M
    has_few_below = (distances_m < -2 * THICK_M).mean(axis=0) <= MOST_BELOW
    scores = np.where(has_few_below, is_on_plane.sum(axis=0), 0)
    scores = np.where(normals[:, 2] > 0, UPSIDE_DOWN * scores, scores)
    if not scores.any():
        return None
    best = int(np.argmax(scores))
    is_ground = is_on_plane[:, best] if near is None else np.abs(cloud @ normals[best] + heights[best]) < THICK_M
    return _fitted_mounting(cloud, is_ground, normals[best])


def common_mounting(mountings: Iterable[Mounting | None]) -> Mounting | None:
    """Median of the mountings estimated from scans of a recording. A tilt below 2 degrees is set to zero.

    Only the upright or only the upside-down mountings count, whichever are more. Returns None if both are equally many,
    or if fewer than half of the scans have a mounting.
    """
    mountings = list(mountings)
    upside_down = [mounting for mounting in mountings if mounting is not None and mounting.up[2] < 0]
    upright = [mounting for mounting in mountings if mounting is not None and mounting.up[2] >= 0]
    majority = max(upside_down, upright, key=len)
    if 2 * len(upside_down + upright) < len(mountings) or len(upside_down) == len(upright):
        return None
    height_m = float(np.median([mounting.height_m for mounting in majority]))
    up = np.median([mounting.up for mounting in majority], axis=0)
    common = Mounting(height_m, _unit(up))
    if min(common.tilt_deg, 180 - common.tilt_deg) < LEVEL_DEG:
        return Mounting(height_m, (0.0, 0.0, float(np.sign(up[2]))))
    return common


def _near_points(points: Float32[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return the first point of each voxel, of the points 0.8 to 25 m from the sensor."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = points.T.astype(np.float64)
        distance = np.sqrt(x * x + y * y + z * z)  # NaN and infinity fail the next test.
        near = points[(distance > NEAR_M[0]) & (distance < NEAR_M[1])].astype(np.float64)
    return one_per_voxel(near, VOXEL_M)


def _sampled_planes(
    points: Float[np.ndarray, "n 3"], *, trials: int
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, " t"]]:
    """Return planes through three random points that may be the ground: normals that point up, and sensor heights."""
    rng = np.random.default_rng(0)
    first = rng.integers(len(points), size=trials)
    others = rng.normal(scale=len(points) / 8, size=(2, trials)).astype(int) + first  # neighbours in the file
    a, b, c = (points[row % len(points)] for row in (first, *others))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    # Twice the area of the triangle, seen from above, must exceed 0.5 m^2: smaller triangles give imprecise planes.
    is_flat = np.abs(normals[:, 2]) > np.maximum(np.cos(np.radians(STEEPEST_DEG)) * lengths, 0.5)
    normals = (normals / np.copysign(np.maximum(lengths, 1e-9), normals[:, 2])[:, None])[is_flat]
    heights = -np.einsum("ti,ti->t", normals, a[is_flat])
    normals, heights = np.concatenate([normals, -normals]), np.concatenate([heights, -heights])  # either side may be up
    least_heights = np.where(normals[:, 2] > 0, HEIGHTS_M[0], LEAST_HANGING_M)
    is_possible = (heights >= least_heights) & (heights <= HEIGHTS_M[1])
    return normals[is_possible], heights[is_possible]


def _fitted_mounting(
    points: Float[np.ndarray, "n 3"], is_ground: Bool[np.ndarray, " n"], up: Float[np.ndarray, "3"]
) -> Mounting | None:
    """Fit a plane to the ground points and select the ground points again, four times. None if it is no ground."""
    normal, centre = up, np.zeros(3)
    for _ in range(4):
        if is_ground.sum() < LEAST_POINTS or is_ground.mean() < LEAST_SHARE:
            return None
        centre = points[is_ground].mean(axis=0)
        normal = np.linalg.svd(points[is_ground] - centre, full_matrices=False)[2][2]  # the direction of least extent
        normal = normal * np.sign(normal @ up)
        is_ground = np.abs((points - centre) @ normal) < THICK_M
    height_m = float(-normal @ centre)
    is_steep = abs(normal[2]) < np.cos(np.radians(STEEPEST_DEG))
    return None if is_steep or not HEIGHTS_M[0] <= height_m <= HEIGHTS_M[1] else Mounting(height_m, _unit(normal))


def _unit(vector: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    """The vector divided by its length."""
    x, y, z = (vector / np.linalg.norm(vector)).tolist()
    return x, y, z
