"""Simulation of a LiDAR: parameters of sensors, and `scan`, which simulates one scan of a world."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sglpr_jax.se3 import are_rotations
from sglpr_jax.sim.ground import GroundView, ground_view, meet_ground
from sglpr_jax.sim.raycast import (
    COLUMNS,
    Candidates,
    Chance,
    Surface,
    echo_returns,
    find_candidates,
    mix_edges,
    nearest_hit,
    reflectivity,
    sector_count,
    surface_of_shapes,
)
from sglpr_jax.sim.shapes import AnyArray, Vectors
from sglpr_jax.sim.world import World

HDL64E_DEG = (*np.linspace(2.0, -8.33, 32).tolist(), *np.linspace(-8.83, -24.8, 32).tolist())
"""Elevations of the HDL-64E in degrees: two blocks of 32 lasers, with a smaller spacing in the upper block."""


def _even(first_deg: float, last_deg: float, count: int) -> tuple[float, ...]:
    """Equally spaced elevations, in degrees."""
    return tuple(np.linspace(first_deg, last_deg, count).tolist())


def _bands(low_deg: float, high_deg: float, count: int) -> tuple[float, ...]:
    """Middle of each of `count` equal bands of elevation, from the top, in degrees."""
    edges = np.linspace(high_deg, low_deg, count + 1)
    return tuple(((edges[:-1] + edges[1:]) / 2).tolist())


TURN_S = 0.1  # duration of a scan, in seconds
STEPS = 0.6180339887498949, 0.7548776662466927, 0.5698402909980532
"""Steps of the sequence in `scattered` from one azimuth, laser and scan to the next: independent irrational numbers."""
LASERS_AT_A_TIME = 16  # maximum size of a block, which divides the number of lasers


ScanPattern = Literal["rings", "scattered", "scattered-round"]


@dataclasses.dataclass(frozen=True)
class Sensor:
    """LiDAR. The default is KITTI's Velodyne HDL-64E without occlusion by the vehicle."""

    elevations_deg: tuple[float, ...] = HDL64E_DEG
    azimuth_steps: int = 1800
    azimuths_deg: tuple[float, float] = (0.0, 360.0)  # first and last azimuth of a scan, counter-clockwise, in degrees
    pattern: ScanPattern = "rings"
    """"rings" repeats the elevations in every scan. "scattered" spreads the rays over the bands around the elevations,
    differently in every scan. "scattered-round" also has a round field of view."""
    height_m: float = 1.73  # height above the road, in metres
    min_range_m: float = 2.5
    max_range_m: float = 80.0
    range_noise_m: float = 0.015  # standard deviation of the range, in metres
    dropout: float = 0.02  # fraction of the returns that are lost, whatever the surface
    faintest_echo: float = 6e-6
    """Strength of an echo that is detected with a probability of 63 %, see `raycast.echo_returns`."""
    edge_share: float = 0.3  # fraction of the returns at an edge whose range is between the ranges of its two sides
    shadows_deg: tuple[tuple[float, float, float], ...] = ()
    """Occlusions by the vehicle: first azimuth, last azimuth (counter-clockwise) and elevation below which no ray
    between these azimuths returns, all in degrees."""

    def __post_init__(self):
        if not self.elevations_deg or self.azimuth_steps < 1:
            found = f"{len(self.elevations_deg)} and {self.azimuth_steps}"
            raise ValueError(f"a sensor needs at least one elevation and one azimuth step, found {found}")
        if not 0 < self.azimuths_deg[1] - self.azimuths_deg[0] <= 360:
            raise ValueError(f"expected azimuths_deg over at most 360 degrees, found {self.azimuths_deg}")
        if not 0 <= self.min_range_m < self.max_range_m:
            raise ValueError(f"expected 0 <= min_range_m < max_range_m, found {self.min_range_m}, {self.max_range_m}")


KITTI_SHADOWS_DEG = (
    (-12.0, 18.0, -21.3),
    (128.0, 139.0, -20.5),
    (158.0, 208.0, -17.5),
    (231.0, 239.0, -20.5),
    (284.0, 302.0, -15.8),
)
"""Occlusions measured in KITTI's scans: bonnet, roof and other parts on the roof. See `Sensor.shadows_deg`."""
HDL64E = Sensor(shadows_deg=KITTI_SHADOWS_DEG)
SENSORS = {
    "hdl64e": HDL64E,
    "hdl32e": Sensor(_even(10.67, -30.67, 32), azimuth_steps=2160, min_range_m=1.0, height_m=1.9),
    # Mounted upside down on a Segway. Elevations and height fit a real scan of NCLT.
    "hdl32e-nclt": Sensor(_even(-10.67, 30.67, 32), azimuth_steps=2160, min_range_m=1.9, height_m=1.03),
    "vlp16": Sensor(_even(15.0, -15.0, 16), min_range_m=0.5, height_m=1.8, range_noise_m=0.03),
    "xt32": Sensor(_even(15.0, -16.0, 32), azimuth_steps=2000, min_range_m=0.5, height_m=0.8, range_noise_m=0.01),
    "os1-64": Sensor(_even(22.5, -22.5, 64), azimuth_steps=1024, min_range_m=0.5, height_m=1.2),
    "os0-32": Sensor(_even(45.0, -45.0, 32), azimuth_steps=1024, min_range_m=0.5, height_m=1.2),
    # RoboSense M1: 120 x 25 degrees in steps of .2 degrees.
    "m1": Sensor(_even(12.5, -12.5, 125), azimuth_steps=600, azimuths_deg=(-60.0, 60.0), min_range_m=0.5),
    # 200,000 points a second over 360 x 59 degrees, 20,000 in a scan.
    "mid360": Sensor(
        _bands(-7.0, 52.0, 20), azimuth_steps=1000, pattern="scattered", min_range_m=0.1, max_range_m=70.0, height_m=1.2
    ),
    # 240,000 points a second over 70.4 x 77.2 degrees, 24,000 in a scan.
    "avia": Sensor(
        _bands(-38.6, 38.6, 64),
        azimuth_steps=480,
        azimuths_deg=(-35.2, 35.2),
        pattern="scattered-round",
        min_range_m=1.0,
    ),
}
"""Real sensors by their names on the command line."""


class View(NamedTuple):
    """Shapes and ground that a sensor may hit from one pose. Array shapes are the same for every pose."""

    candidates: tuple[Candidates, ...]
    ground: GroundView
    rotation: AnyArray  # (3, 3) rotation of world_from_lidar
    rays: Vectors | None = None  # unit vectors of the rays; None if they are the same in every scan


class Turn(NamedTuple):
    """Returns of one revolution. The first axes of the arrays are (lasers, azimuths)."""

    points: AnyArray  # (..., 4) x, y, z in metres in the LiDAR frame, intensity 0 to 1
    labels: AnyArray  # int32 raw SemanticKITTI ids
    returned: AnyArray  # bool; where false, point and label are invalid


def scan(
    key: Array,
    world: World,
    world_from_lidar: Float[np.ndarray, "4 4"],
    *,
    sensor: Sensor = HDL64E,
    time: float = 0.0,
) -> tuple[Float[np.ndarray, "n 4"], Int[np.ndarray, " n"]]:
    """Simulates one scan of a world at `time` (seconds): points laser by laser, each counter-clockwise, as in KITTI.

    Returns:
      Points (x, y, z in metres in the LiDAR frame, intensity from 0 to 1) and their raw labels.

    Raises:
      ValueError: The pose is not rigid.
    """
    view = view_of(world, world_from_lidar, sensor=sensor, time=time)
    return returned_points(cast_turn(key, view, sensor=sensor))


def view_of(
    world: World, world_from_lidar: Float[np.ndarray, "4 4"], *, sensor: Sensor = HDL64E, time: float = 0.0
) -> View:
    """Selects the shapes and the ground that the sensor may hit from a pose. Raises the errors of `scan`."""
    rotation = world_from_lidar[:3, :3]
    if not (np.isfinite(world_from_lidar).all() and are_rotations(rotation)):
        raise ValueError(f"expected a pose of rotation and translation, found {world_from_lidar.tolist()}")
    candidates = find_candidates(
        world.scene,
        world_from_lidar,
        time=time,
        azimuth_steps=sensor.azimuth_steps,
        azimuths_deg=sensor.azimuths_deg,
        reach_m=sensor.max_range_m,
    )
    ground = ground_view(world.ground, world_from_lidar[:3, 3], reach_m=sensor.max_range_m)
    rays = None if sensor.pattern == "rings" else _ray_directions(sensor, time=time)
    return View(candidates, ground, rotation.astype(np.float32), rays)


@functools.partial(jax.jit, static_argnames="sensor")
def cast_turn(key: Array, view: View, *, sensor: Sensor) -> Turn:
    """Casts the rays of one revolution. `jax.vmap` over keys and views simulates many revolutions."""
    key_surface, key_echoes = jax.random.split(key)
    surface = first_surface(key_surface, view, sensor=sensor)
    ranges, returned = _measured_ranges(key_echoes, surface, sensor)
    xyz = [axis[:, : sensor.azimuth_steps] * ranges for axis in _rays_of_view(view, sensor)]
    intensity = reflectivity(surface.label) * (0.5 + 0.5 * surface.facing)
    return Turn(jnp.stack([*xyz, intensity], axis=-1), surface.label, returned)


def returned_points(turn: Turn) -> tuple[Float[np.ndarray, "n 4"], Int[np.ndarray, " n"]]:
    """Points and labels of the returns of one revolution, on the host."""
    points, labels, returned = (np.asarray(array) for array in turn)
    rows = np.flatnonzero(returned)
    return points.reshape(-1, 4).take(rows, axis=0), labels.take(rows)


@functools.partial(jax.jit, static_argnames="sensor")
def first_surface(key: Array, view: View, *, sensor: Sensor) -> Surface:
    """Finds the ground or shape that each ray (lasers, azimuths) hits first, in blocks of LASERS_AT_A_TIME lasers.

    Ray casting in a block stops at its farthest hit, so blocks of low lasers, which hit the near ground, finish early.
    """
    rays = _rays_of_view(view, sensor)
    lasers, azimuths = rays.x.shape
    key_depth, key_pores = jax.random.split(key)
    chance = Chance(jax.random.exponential(key_depth, rays.x.shape), jax.random.bits(key_pores, rays.x.shape))

    def surface_of_block(block: tuple[Vectors, Chance]) -> Surface:
        rays, chance = block
        world_rays = Vectors(*(row[0] * rays.x + row[1] * rays.y + row[2] * rays.z for row in view.rotation))
        distance, label, facing = meet_ground(world_rays, view.ground, reach_m=sensor.max_range_m)
        distance = jnp.minimum(distance, sensor.max_range_m)
        ground = Surface(distance, label, facing, jnp.zeros(distance.shape, bool))
        hit_distance, slot = nearest_hit(world_rays, view.candidates, distance, chance)
        shape = surface_of_shapes(world_rays, hit_distance, slot, view.candidates)
        is_shape = shape.distance < ground.distance
        return jax.tree.map(lambda of_ground, of_shape: jnp.where(is_shape, of_shape, of_ground), ground, shape)

    block_shape = (-1, math.gcd(lasers, LASERS_AT_A_TIME), azimuths)
    blocks = jax.tree.map(lambda array: array.reshape(block_shape), (rays, chance))
    surface = jax.lax.map(surface_of_block, blocks)
    return jax.tree.map(lambda array: array.reshape(lasers, azimuths)[:, : sensor.azimuth_steps], surface)


def _rays_of_view(view: View, sensor: Sensor) -> Vectors:
    return _ray_directions(sensor) if view.rays is None else view.rays


def _ray_directions(sensor: Sensor, *, time: float = 0.0) -> Vectors:
    """Unit vectors of the rays in the LiDAR frame, as arrays (lasers, azimuths). The azimuths fill whole sectors."""
    columns = sector_count(sensor.azimuth_steps) * COLUMNS
    first, last = np.radians(sensor.azimuths_deg)
    azimuth = (first + np.arange(columns) * ((last - first) / sensor.azimuth_steps))[None, :]
    if sensor.pattern == "rings":
        elevation = np.radians(np.array(sensor.elevations_deg)[:, None])
    else:
        elevation = np.radians(scattered(sensor.elevations_deg, columns, time=time))
    horizontal, z = np.cos(elevation), np.broadcast_to(np.sin(elevation), (len(elevation), columns))
    axes = (horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), z)
    return Vectors(*(jnp.asarray(axis, jnp.float32) for axis in axes))


def _measured_ranges(key: Array, surface: Surface, sensor: Sensor) -> tuple[Array, Array]:
    """Measured range of each ray in metres, 0 without a return, and whether the ray returns."""
    key_noise, key_detection, key_edge = jax.random.split(key, 3)
    shape = surface.distance.shape
    returned = (surface.distance < sensor.max_range_m) & echo_returns(
        jax.random.uniform(key_detection, shape), surface, faintest_echo=sensor.faintest_echo, dropout=sensor.dropout
    )
    ranges = mix_edges(jax.random.uniform(key_edge, shape), surface.distance, returned, share=sensor.edge_share)
    ranges = ranges + sensor.range_noise_m * jax.random.normal(key_noise, shape)
    returned &= (ranges >= sensor.min_range_m) & (ranges < sensor.max_range_m) & ~_is_hidden(sensor)
    return jnp.where(returned, ranges, 0), returned


def _is_hidden(sensor: Sensor) -> Bool[np.ndarray, "lasers azimuths"]:
    """Whether the vehicle occludes each ray, or the ray is outside a round field of view."""
    first, last = sensor.azimuths_deg
    azimuth = first + np.arange(sensor.azimuth_steps) * ((last - first) / sensor.azimuth_steps)
    elevation = np.array(sensor.elevations_deg)[:, None]
    is_hidden = np.zeros((len(elevation), len(azimuth)), bool)
    if sensor.pattern == "scattered-round":
        is_hidden |= _scaled(elevation) ** 2 + _scaled(azimuth) ** 2 > 1
    for first, last, lowest in sensor.shadows_deg:
        is_hidden |= ((azimuth - first) % 360 <= last - first) & (elevation < lowest)
    return is_hidden


def _scaled(angles: np.ndarray) -> np.ndarray:
    """Maps angles linearly to [-1, 1]."""
    return (angles - (angles.max() + angles.min()) / 2) / (np.ptp(angles) / 2)


def scattered(elevations_deg: Sequence[float], azimuths: int, *, time: float) -> Float[np.ndarray, "lasers {azimuths}"]:
    """Elevation of each ray in degrees, for a sensor that, like those of Livox, does not repeat its pattern.

    A low-discrepancy sequence fills the bands around `elevations_deg` evenly in space and, scan after scan, in time.
    """
    band_middle = np.array(elevations_deg)
    band_height = abs(band_middle[1] - band_middle[0])
    azimuth, laser, scan = np.arange(azimuths), np.arange(len(band_middle))[:, None], time / TURN_S
    fraction = (azimuth * STEPS[0] + laser * STEPS[1] + scan * STEPS[2]) % 1
    return band_middle[:, None] + band_height * (fraction - 0.5)
