"""A spinning LiDAR: one turn of its lasers over a world."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sglpr_jax.sim.shapes import AnyArray, Scene, Shapes, Vectors, nearest_hit
from sglpr_jax.sim.world import CELL_M, GROUND, Ground, World

HDL64E_DEG = (*np.linspace(2.0, -8.33, 32).tolist(), *np.linspace(-8.83, -24.8, 32).tolist())
"""The elevations of the HDL-64E: two blocks of 32 lasers, the upper one finer."""
SHAPES_IN_VIEW = 256, 128, 160
"""How many boxes, cylinders and ellipsoids a scan may meet: fixed, so that one compiled program does for every scan.

Meeting all of them instead changes the label of 1 % of the points, most of them far away.
"""


@dataclasses.dataclass(frozen=True)
class Sensor:
    """A spinning LiDAR; the default is KITTI's Velodyne HDL-64E."""

    elevations_deg: tuple[float, ...] = HDL64E_DEG
    azimuth_steps: int = 1800
    height_m: float = 1.73
    """Above the road."""
    max_range_m: float = 80.0
    range_noise_m: float = 0.02
    """Standard deviation along the ray."""
    dropout: float = 0.05
    """Share of the returns that are lost."""

    def __post_init__(self):
        if not self.elevations_deg or self.azimuth_steps < 1:
            raise ValueError(
                "a sensor needs at least one elevation and one azimuth step, found "
                f"{len(self.elevations_deg)} and {self.azimuth_steps}"
            )


HDL64E = Sensor()


def scan(
    key: Array, world: World, world_from_lidar: Float[np.ndarray, "4 4"], *, sensor: Sensor = HDL64E
) -> tuple[Float[np.ndarray, "n 4"], Int[np.ndarray, " n"]]:
    """Return one scan of `world`: points (x, y, z in metres in the LiDAR frame, intensity 0 to 1) and raw labels.

    Points come as in KITTI's files: laser by laser from the top, each laser counter-clockwise from straight ahead. The
    pose must be level; rays start at its origin, and the road is the plane z = 0 of the world. Intensity depends on the
    range alone.

    Raises ValueError where the pose is tilted.
    """
    if not np.allclose(world_from_lidar[2, :3], (0, 0, 1)) or not np.allclose(world_from_lidar[:3, 2], (0, 0, 1)):
        raise ValueError(f"expected a level pose, found the rotation {world_from_lidar[:3, :3].tolist()}")
    scene = _in_view(world.scene, world_from_lidar, max_range_m=sensor.max_range_m)
    ground = world.ground.around(world_from_lidar[:2, 3], sensor.max_range_m)
    points, labels, returned = _turn(key, scene, ground, world_from_lidar.astype(np.float32), sensor=sensor)
    returned = np.asarray(returned)
    return np.asarray(points)[returned], np.asarray(labels)[returned]


def _in_view(scene: Scene, world_from_lidar: Float[np.ndarray, "4 4"], *, max_range_m: float) -> Scene:
    """The shapes that look largest from the sensor, in the LiDAR frame, a fixed number of each kind."""
    return Scene(
        *(
            _largest(shapes, world_from_lidar, count, max_range_m)
            for shapes, count in zip(scene, SHAPES_IN_VIEW, strict=True)
        )
    )


def _largest(shapes: Shapes, world_from_lidar: Float[np.ndarray, "4 4"], count: int, max_range_m: float) -> Shapes:
    rotation, position = world_from_lidar[:3, :3], world_from_lidar[:3, 3]
    centre = (shapes.centre - position) @ rotation
    radius = np.linalg.norm(shapes.half, axis=1)
    clearance = np.maximum(np.linalg.norm(centre, axis=1) - radius, 0.1)
    by_size = np.argsort(-radius / clearance, kind="stable")
    chosen = by_size[clearance[by_size] <= max_range_m][:count]

    def pad(values: AnyArray, filler: float | int, dtype: type) -> np.ndarray:
        width = [(0, count - len(chosen))] + [(0, 0)] * (values.ndim - 1)
        return np.pad(values[chosen], width, constant_values=filler).astype(dtype)

    yaw = shapes.yaw - np.arctan2(rotation[1, 0], rotation[0, 0])
    return Shapes(
        centre=pad(centre, 1e6, np.float32),  # a thousand kilometres away: never hit within the range limit
        half=pad(shapes.half, 1, np.float32),
        yaw=pad(yaw, 0, np.float32),
        label=pad(shapes.label, 0, np.int32),
        roughness=pad(shapes.roughness, 0, np.float32),
    )


def _rays(sensor: Sensor) -> Vectors:
    """One ray per laser and azimuth, of horizontal length 1: x and y are (1, azimuths), z is (lasers, 1)."""
    azimuth = np.arange(sensor.azimuth_steps) * (2 * np.pi / sensor.azimuth_steps)
    slope = np.tan(np.radians(sensor.elevations_deg))
    x, y, z = np.cos(azimuth)[None, :], np.sin(azimuth)[None, :], slope[:, None]
    return Vectors(*(jnp.asarray(axis, jnp.float32) for axis in (x, y, z)))


def _ground_label(ground: Ground, x: Array, y: Array) -> Array:
    rows, columns = ground.label.shape
    row = jnp.clip(jnp.floor((y - ground.origin[1]) / CELL_M).astype(jnp.int32), 0, rows - 1)
    column = jnp.clip(jnp.floor((x - ground.origin[0]) / CELL_M).astype(jnp.int32), 0, columns - 1)
    return ground.label[row, column].astype(jnp.int32)


@functools.partial(jax.jit, static_argnames="sensor")
def _turn(
    key: Array, scene: Scene, ground: Ground, world_from_lidar: Float[Array, "4 4"], *, sensor: Sensor
) -> tuple[Float[Array, "rays 4"], Int[Array, " rays"], Array]:
    """Points, labels and whether anything came back, for every ray; `scene` is in the LiDAR frame."""
    rays = _rays(sensor)
    distance, index = nearest_hit(rays, scene)
    to_road = jnp.where(rays.z < 0, -world_from_lidar[2, 3] / rays.z, jnp.inf)
    label = jnp.where(to_road < distance, GROUND, jnp.concatenate([shapes.label for shapes in scene])[index])
    roughness = jnp.concatenate([shapes.roughness for shapes in scene])[index] * (to_road >= distance)
    distance = jnp.minimum(distance, to_road)

    key_noise, key_depth, key_dropout = jax.random.split(key, 3)
    length = jnp.sqrt(1 + rays.z**2)  # of a ray whose horizontal length is 1
    noise = sensor.range_noise_m * jax.random.normal(key_noise, distance.shape)
    depth = roughness * jnp.abs(jax.random.normal(key_depth, distance.shape))
    reach = distance * length + noise + depth
    returned = (reach < sensor.max_range_m) & (jax.random.uniform(key_dropout, distance.shape) >= sensor.dropout)
    reach = jnp.where(returned, reach, 0)

    x, y, z = (axis * (reach / length) for axis in rays)
    (cos, _, _, east), (sin, _, _, north) = world_from_lidar[0], world_from_lidar[1]
    ground_label = _ground_label(ground, cos * x - sin * y + east, sin * x + cos * y + north)
    label = jnp.where(label == GROUND, ground_label, label)
    points = jnp.stack([x, y, z, 0.4 * jnp.exp(-reach / 40)], axis=-1)
    return points.reshape(-1, 4), label.reshape(-1), returned.reshape(-1)
