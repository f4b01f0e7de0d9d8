"""Small scenes for tests of rays and sensor, and a numpy reference that tries every surface of every shape."""

import numpy as np
from scipy.spatial.transform import Rotation

from sglpr_jax.se3 import poses_of
from sglpr_jax.sim.ground import Ground, Relief
from sglpr_jax.sim.shapes import Scene, Shapes

FLAT = Relief(np.zeros(1), np.full((1, 2), 0.01), np.zeros(1))
HILLS = Relief(np.array([1.5, 0.8]), np.array([[0.012, 0.004], [-0.01, 0.025]]), np.array([0.3, 2.0]))
"""Slopes up to 4 %."""


def shapes(*rows: tuple[float, ...], **columns) -> Shapes:
    """Rows of x, y, z, three half sizes, yaw, label; other columns by name, the same for all rows."""
    table = np.array(rows, dtype=float).reshape(-1, 8)
    n = len(table)
    plain = Shapes(
        centre=table[:, :3],
        half=table[:, 3:6],
        yaw=table[:, 6],
        label=table[:, 7].astype(np.int32),
        roughness=np.zeros(n),
        porosity=np.zeros(n),
        glass=np.zeros(n),
        velocity=np.zeros((n, 2)),
        since=np.full(n, -np.inf),
        until=np.full(n, np.inf),
    )
    return plain._replace(
        **{name: np.broadcast_to(value, getattr(plain, name).shape) for name, value in columns.items()}
    )


NOTHING = shapes()


def random_shapes(rng: np.random.Generator, count: int) -> Shapes:
    """Shapes 6 to 60 m from the origin."""
    bearing, away = rng.uniform(-np.pi, np.pi, count), rng.uniform(6, 60, count)
    centre = np.stack([away * np.cos(bearing), away * np.sin(bearing), rng.uniform(-2, 2, count)], axis=1)
    half, yaw, label = rng.uniform(0.1, 3, (count, 3)), rng.uniform(-np.pi, np.pi, count), rng.integers(1, 99, count)
    return shapes(*np.column_stack([centre, half, yaw, label]))


def random_scene(seed: int, count: int = 12) -> Scene:
    """`count` shapes of each kind."""
    rng = np.random.default_rng(seed)
    return Scene(*(random_shapes(rng, count) for _ in range(3)))


def pose(x: float = 0, y: float = 0, z: float = 0, *, yaw: float = 0, pitch: float = 0, roll: float = 0) -> np.ndarray:
    """world_from_lidar that turns about z after y after x."""
    rotation = Rotation.from_euler("ZYX", (yaw, pitch, roll)).as_matrix()
    return poses_of(np.array([[x, y, z]], float), rotation[None])[0]


def striped_ground(relief: Relief, low: int, high: int) -> Ground:
    """Ground of 100 m around the origin that is `low` for y > 0 and `high` elsewhere."""
    label = np.full((800, 800), high, np.uint8)
    label[400:] = low
    return Ground(label, np.array([-100.0, -100.0]), relief)


def local(vectors: np.ndarray, these: Shapes, i: int) -> np.ndarray:
    """Vectors in the unit frame of shape `i`."""
    cos, sin = np.cos(these.yaw[i]), np.sin(these.yaw[i])
    return vectors @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]).T / these.half[i]


def _first_of(distances: np.ndarray, on_surface: np.ndarray) -> np.ndarray:
    return np.where(on_surface & (distances > 0), distances, np.inf).min(axis=0)


def _face_hits(o: np.ndarray, d: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """Distances to the planes at -1 and 1 of each of `axes`: (planes, rays)."""
    return np.stack([(side - o[axis]) / d[:, axis] for axis in axes for side in (-1, 1)])


def _quadric_hits(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distances at which |o + t d| = 1: (2, rays), NaN where there are none."""
    a, b, c = (d * d).sum(1), 2 * (d @ o), o @ o - 1
    with np.errstate(invalid="ignore"):
        root = np.sqrt(b * b - 4 * a * c)
    return np.stack([(-b - root) / (2 * a), (-b + root) / (2 * a)])


def _box_distance(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    t = _face_hits(o, d, (0, 1, 2))
    return _first_of(t, np.abs(o + t[..., None] * d).max(-1) <= 1 + 1e-9)


def _cylinder_distance(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    mantle, caps = _quadric_hits(o[:2], d[:, :2]), _face_hits(o, d, (2,))
    on_mantle = np.abs(o[2] + mantle * d[:, 2]) <= 1
    on_cap = np.linalg.norm(o[:2] + caps[..., None] * d[:, :2], axis=-1) <= 1
    return np.minimum(_first_of(mantle, on_mantle), _first_of(caps, on_cap))


def _ellipsoid_distance(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    t = _quadric_hits(o, d)
    return _first_of(t, np.isfinite(t))


def reference(
    directions: np.ndarray, sensor: np.ndarray, scene: Scene, grow: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Distance and index of the first surface of all for rays (n, 3) from `sensor`; `grow` scales every shape."""
    rows = []
    for these, distance in zip(scene, (_box_distance, _cylinder_distance, _ellipsoid_distance), strict=True):
        grown = these._replace(half=these.half * grow)
        for i in range(len(these.label)):
            rows.append(distance(local(sensor - these.centre[i], grown, i), local(directions, grown, i)))
    rows = np.array(rows)
    return rows.min(0), np.where(np.isfinite(rows.min(0)), rows.argmin(0), -1)
