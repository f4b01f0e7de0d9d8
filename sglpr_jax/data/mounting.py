"""How a sensor is mounted: its height over the ground, and where up is; and the ground that tells it.

A density image leaves out what lies more than 1.2 m below the sensor, which is right for a sensor 1.73 m above a road.
Clouds of other sensors are brought there: turned upright, and moved up or down.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

MODEL_HEIGHT_M = 1.73
"""Above the road: KITTI's Velodyne, that of the simulator, and so that of all weights that ship."""
HEIGHTS_M = (-0.5, 4.5)
"""Between which a sensor's height is sought: points in the vehicle's own frame, a lorry's roof."""
LEAST_HANGING_M = 0.2
"""Of a sensor that hangs upside down."""
STEEPEST_DEG = 35.0
"""Farthest of the sensor's z axis from up, or from down."""
LEVEL_DEG = 2.0
"""Less than this is the road's slope and the springs', not the mounting's."""
NEAR_M = (0.8, 25.0)
"""The ground is sought where the points are so far from the sensor."""
VOXEL_M = 0.4
"""One point of each such voxel is taken, because most points lie on the nearest metres of ground."""
THICK_M = 0.12
"""Points so far from the plane are of the ground."""
MOST_BELOW = 0.1
"""Share of the points that may lie below the ground: mirror images, and slopes that go down."""
LEAST_SHARE = 0.05
LEAST_POINTS = 40
"""Of the voxels, and how many of them, must be of the ground."""
MOST_POINTS = 6000
"""As many of them are enough."""
TRIALS = 400
UPSIDE_DOWN = 2.0
"""How many times as much ground must lie above a sensor as below for it to hang upside down: rooms have ceilings."""


@dataclass(frozen=True)
class Mounting:
    """A sensor's height over the ground and, in its own frame, the direction of up (of length 1)."""

    height_m: float
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self):
        if not (math.isfinite(self.height_m) and -1 < self.height_m < 100):
            raise ValueError(f"expected the sensor's height over the ground in metres, found {self.height_m}")

    @property
    def tilt_deg(self) -> float:
        """The angle between the sensor's z axis and up; 180 where it hangs upside down."""
        return math.degrees(math.acos(min(1.0, max(-1.0, self.up[2]))))

    @property
    def upright_from_lidar(self) -> Float[np.ndarray, "3 3"]:
        """The rotation that turns up to z, by the smallest angle; after half a turn about x for what hangs."""
        half = np.diag([1.0, -1.0, -1.0]) if self.up[2] < 0 else np.eye(3)
        x, y, z = half @ np.array(self.up)
        cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
        return (np.eye(3) + cross + cross @ cross / (1 + z)) @ half

    def level(self, points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
        """Points (n, 3) as an upright sensor at `MODEL_HEIGHT_M` has them. Those that are not finite stay so."""
        if self.up == (0.0, 0.0, 1.0):
            lifted = points.copy(order="K")
            lifted[:, 2] += np.float32(self.height_m - MODEL_HEIGHT_M)
            return lifted
        with np.errstate(invalid="ignore"):
            turned = points.astype(np.float64) @ self.upright_from_lidar.T
        return (turned + np.array([0, 0, self.height_m - MODEL_HEIGHT_M])).astype(np.float32)

    def __str__(self) -> str:
        hangs = self.up[2] < 0
        tilt = 180 - self.tilt_deg if hangs else self.tilt_deg
        parts = [f"{self.height_m:.2f} m above the ground", *(["upside down"] if hangs else [])]
        return ", ".join([*parts, *([f"tilted by {tilt:.0f} degrees"] if tilt >= LEVEL_DEG else [])])


def estimate_mounting(points: Float32[np.ndarray, "n 3"]) -> Mounting | None:
    """Find the ground of one scan (metres): the plane below which next to nothing lies; None where there is none.

    Planes through three points are tried (RANSAC, always the same ones of a cloud), the best one is fitted to all its
    points. It may be tilted by 35 degrees against the sensor's z axis, and the sensor may hang upside down.

    Example:
      mounting = estimate_mounting(recording.points(0))
    """
    near = _thinned(points)
    near = near[:: len(near) // MOST_POINTS + 1]
    if len(near) < LEAST_POINTS:
        return None
    normals, heights = _planes(near)
    if not len(heights):
        return None
    distances = near @ normals.T + heights
    ground = np.abs(distances) < THICK_M
    score = np.where((distances < -2 * THICK_M).mean(axis=0) <= MOST_BELOW, ground.sum(axis=0), 0)
    score = np.where(normals[:, 2] > 0, UPSIDE_DOWN * score, score)
    best = int(np.argmax(score))
    if score[best] == 0:
        return None
    return _fitted(near, ground[:, best], normals[best])


def common_mounting(found: Iterable[Mounting | None]) -> Mounting | None:
    """Return the median of what the scans of a recording tell; None where fewer than half of them tell anything.

    Those that disagree with most on whether the sensor hangs upside down are left out; None too where as many say one
    as the other. A tilt below 2 degrees counts as none.
    """
    scans = list(found)
    seen = [mounting for mounting in scans if mounting is not None]
    agreed = _on_one_side(seen)
    if 2 * len(seen) < len(scans) or not agreed:
        return None
    height = float(np.median([mounting.height_m for mounting in agreed]))
    up = np.median([mounting.up for mounting in agreed], axis=0)
    mounting = Mounting(height, _unit(up))
    if min(mounting.tilt_deg, 180 - mounting.tilt_deg) < LEVEL_DEG:
        return Mounting(height, (0.0, 0.0, float(np.sign(up[2]))))
    return mounting


def _on_one_side(seen: Sequence[Mounting]) -> Sequence[Mounting]:
    """The upright ones or those that hang, whichever are more: opposite directions have no median. None at a tie."""
    hanging = [mounting for mounting in seen if mounting.up[2] < 0]
    upright = [mounting for mounting in seen if mounting.up[2] >= 0]
    return [] if len(hanging) == len(upright) else max(hanging, upright, key=len)


def _thinned(points: Float32[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """One point of every voxel near the sensor, the first in the file."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = points.T.astype(np.float64)
        distance = np.sqrt(x * x + y * y + z * z)  # neither near nor far where a coordinate is not finite
        near = points[(distance > NEAR_M[0]) & (distance < NEAR_M[1])].astype(np.float64)
    if not len(near):
        return near
    x, y, z = np.floor(near.T / VOXEL_M).astype(np.int64) + 128
    _, first = np.unique((z * 256 + y) * 256 + x, return_index=True)
    return near[np.sort(first)]


def _planes(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, " t"]]:
    """Planes that may be the ground: normals that point up, and the sensor's heights above the planes."""
    rng = np.random.default_rng(0)
    first = rng.integers(len(points), size=TRIALS)
    near = rng.normal(scale=len(points) / 8, size=(2, TRIALS)).astype(int) + first  # neighbours in the file, often
    a, b, c = (points[index % len(points)] for index in (first, *near))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    kept = np.abs(normals[:, 2]) > np.maximum(np.cos(np.radians(STEEPEST_DEG)) * lengths, 0.5)
    normals = (normals / np.copysign(np.maximum(lengths, 1e-9), normals[:, 2])[:, None])[kept]
    heights = -np.einsum("ti,ti->t", normals, a[kept])
    normals, heights = np.concatenate([normals, -normals]), np.concatenate([heights, -heights])  # either side is up
    kept = (heights >= np.where(normals[:, 2] > 0, HEIGHTS_M[0], LEAST_HANGING_M)) & (heights <= HEIGHTS_M[1])
    return normals[kept], heights[kept]


def _fitted(
    points: Float[np.ndarray, "n 3"], ground: Bool[np.ndarray, " n"], up: Float[np.ndarray, "3"]
) -> Mounting | None:
    """The plane of least squares through the points of the ground, and those that are then of the ground."""
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
