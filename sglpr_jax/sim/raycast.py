"""First hit of each ray of a LiDAR with a shape, and whether its echo is detected.

A sector is COLUMNS neighbouring azimuth steps. The host lists the shapes in each sector, nearest first. The device
tests one shape per sector at a time, until the remaining shapes are farther than all hits.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sglpr_jax.se3 import wrap_angle
from sglpr_jax.sim import labels
from sglpr_jax.sim.shapes import SOLIDS, AnyArray, Scene, Shapes, Solid, Vectors, at_time

COLUMNS = 32  # number of azimuth steps in a sector
SLOTS = 64, 48, 128  # maximum numbers of boxes, cylinders and ellipsoids in a sector; the nearest are kept
UNROLL = 2  # shapes tested between two checks of the stop condition; it divides all numbers of slots
_MARGIN = 1e-3  # added to the half width of a sector, in radians
# Random odd factor for each slot: multiplied by a ray's random bits modulo 2^32, it gives independent bits per shape.
_PORE_FACTORS = np.random.default_rng(0).integers(2**32, size=sum(SLOTS), dtype=np.uint32) | np.uint32(1)
PerRay = Float[Array, "lasers azimuths"]
Nearest = tuple[Array, Array]
"""Distance and slot of the nearest hit of each ray. The slot is -1 without a hit."""
STOREY_M, BAY_M = 3.0, 2.5  # height and width of a piece of facade with one window, in metres
WINDOW_LOSS = 0.9  # fraction of the rays into a window that do not return
LEAF_FACING = 0.5  # mean cosine of the angle between a ray and the normal of a leaf, for all rough shapes
EDGE_JUMP_M = 2.0  # distance above which the sensor separates two echoes, in metres


class Candidates(NamedTuple):
    """Shapes of one kind that the rays of each sector may hit, nearest first. Every array is (slots, sectors).

    A shape is stored as the transformation to its unit frame (see `shapes`) from the sensor's position and world axes.
    """

    xx: AnyArray  # x in the unit frame = xx * x + xy * y + origin.x, and likewise for y and z; 1 / metres
    xy: AnyArray
    yx: AnyArray
    yy: AnyArray
    zz: AnyArray
    origin: Vectors  # position of the sensor in the unit frame
    nearest: AnyArray  # lower bound of the distance from the sensor, metres; inf in an empty slot
    roughness: AnyArray
    porosity: AnyArray  # uint32: fraction of the rays that pass through the shape, times 2^32
    glass: AnyArray
    label: AnyArray  # int32


class Chance(NamedTuple):
    """Random numbers for each ray."""

    depth: AnyArray  # exponentially distributed with mean 1: depth at which a rough shape returns the ray
    pores: AnyArray  # uint32, uniform: decides which porous shapes the ray passes through


def sector_count(azimuth_steps: int) -> int:
    """Number of sectors in a scan. The last one may extend beyond the last azimuth."""
    return -(-azimuth_steps // COLUMNS)


def find_candidates(
    scene: Scene,
    world_from_lidar: Float[np.ndarray, "4 4"],
    *,
    time: float,
    azimuth_steps: int,
    azimuths_deg: tuple[float, float] = (0.0, 360.0),
    reach_m: float,
) -> tuple[Candidates, ...]:
    """Lists the boxes, cylinders and ellipsoids within `reach_m` that the rays of each sector may hit at `time`."""
    first, last = np.radians(azimuths_deg)
    step = (last - first) / azimuth_steps
    sector_middle = first + (np.arange(sector_count(azimuth_steps)) * COLUMNS + (COLUMNS - 1) / 2) * step
    sector_half_width = (COLUMNS - 1) / 2 * step + _MARGIN
    sensor_xyz = world_from_lidar[:3, 3]
    candidates = []
    for shapes, slot_count in zip(scene, SLOTS, strict=True):
        present = at_time(shapes, time, sensor_xyz, reach_m=reach_m)
        shape_middle, shape_half_width = _azimuth_intervals(present, world_from_lidar)
        angle = np.abs(wrap_angle(shape_middle[:, None] - sector_middle))
        overlap = angle <= shape_half_width[:, None] + sector_half_width
        candidates.append(_nearest_shapes(present, sensor_xyz, overlap, slot_count))
    return tuple(candidates)


def _azimuth_intervals(shapes: Shapes, world_from_lidar: Float[np.ndarray, "4 4"]) -> tuple[np.ndarray, np.ndarray]:
    """Middle and half width of the azimuth interval of each shape's corners, in the LiDAR frame, in radians."""
    signs = np.stack(np.meshgrid((-1, 1), (-1, 1), (-1, 1)), axis=-1).reshape(-1, 3)
    corners = signs * shapes.half[:, None]  # (shapes, 8, 3), in the axes of each shape
    cos, sin = np.cos(shapes.yaw)[:, None], np.sin(shapes.yaw)[:, None]
    offset = shapes.centre - world_from_lidar[:3, 3]
    rotated_x = cos * corners[..., 0] - sin * corners[..., 1]
    rotated_y = sin * corners[..., 0] + cos * corners[..., 1]
    corners = np.stack([rotated_x, rotated_y, corners[..., 2]], axis=-1) + offset[:, None]

    lidar_yx = world_from_lidar[:3, 1::-1]  # axes y and x of the LiDAR, in the order of arctan2
    corner_azimuth = np.arctan2(*np.moveaxis(corners @ lidar_yx, -1, 0))
    centre_azimuth = np.arctan2(*(offset @ lidar_yx).T)
    deviation = wrap_angle(corner_azimuth - centre_azimuth[:, None])
    low, high = deviation.min(axis=1), deviation.max(axis=1)
    # A shape that spans half a revolution or more is around, above or below the sensor, so any ray may hit it.
    return centre_azimuth + (low + high) / 2, np.where(high - low < np.pi, (high - low) / 2, np.pi)


def _nearest_shapes(
    shapes: Shapes, sensor_xyz: Float[np.ndarray, "3"], overlap: np.ndarray, slot_count: int
) -> Candidates:
    """Nearest `slot_count` shapes of each sector, among the shapes with a true `overlap` (shapes, sectors)."""
    cos, sin, offset = np.cos(shapes.yaw), np.sin(shapes.yaw), shapes.centre - sensor_xyz
    along, across = cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0]
    centre = np.stack([along, across, offset[:, 2]], axis=1)  # relative to the sensor, in the axes of each shape
    nearest = np.linalg.norm(np.maximum(np.abs(centre) - shapes.half, 0), axis=1)

    order = np.argsort(nearest, kind="stable")
    slot = np.cumsum(overlap[order], axis=0) - 1
    rank, sector = np.nonzero(overlap[order] & (slot < slot_count))
    shape_in_slot = np.full((slot_count, overlap.shape[1]), -1)
    shape_in_slot[slot[rank, sector], sector] = order[rank]

    def fill(per_shape: AnyArray, empty: float, dtype: type = np.float32) -> np.ndarray:
        return np.append(per_shape, empty)[shape_in_slot].astype(dtype)  # index -1 selects `empty`

    (hx, hy, hz), origin = shapes.half.T, -centre / shapes.half
    return Candidates(
        xx=fill(cos / hx, 1.0),
        xy=fill(sin / hx, 0.0),
        yx=fill(-sin / hy, 0.0),
        yy=fill(cos / hy, 1.0),
        zz=fill(1 / hz, 1.0),
        origin=Vectors(*(fill(axis, 1e6) for axis in origin.T)),  # an empty slot is 1000 km away, so never hit
        nearest=fill(nearest, np.inf),
        roughness=fill(shapes.roughness, 0.0),
        porosity=fill(np.minimum(shapes.porosity * 2.0**32, 2.0**32 - 1), 0.0, np.uint32),
        glass=fill(shapes.glass, 0.0),
        label=fill(shapes.label, 0.0, np.int32),
    )


def into_unit_frame(vectors: Vectors, shape: Candidates) -> Vectors:
    """Transforms directions into the unit frame of a shape."""
    return Vectors(
        shape.xx * vectors.x + shape.xy * vectors.y,
        shape.yx * vectors.x + shape.yy * vectors.y,
        shape.zz * vectors.z,
    )


def nearest_hit(
    rays: Vectors, candidates: Sequence[Candidates], limit: PerRay, chance: Chance
) -> tuple[PerRay, Int[Array, "lasers azimuths"]]:
    """Returns the distance to the first shape that each ray from the sensor hits, and its slot.

    Slots count boxes, then cylinders, then ellipsoids. Without a hit nearer than `limit`, they are `limit` and -1. A
    shape that contains the sensor is not hit. A ray enters a rough shape by a random depth, or leaves it without a hit.
    """
    by_sector = (limit.shape[0], -1, COLUMNS)  # lasers, sectors, columns
    rays, limit, chance = jax.tree.map(
        lambda array: jnp.broadcast_to(array, limit.shape).reshape(by_sector), (rays, limit, chance)
    )
    nearest, first_slot = (limit, jnp.full(limit.shape, -1, jnp.int32)), 0
    for shapes, solid in zip(jax.tree.map(jnp.asarray, candidates), SOLIDS, strict=True):
        nearest = _nearest_of_kind(rays, shapes, first_slot, solid, nearest, chance)
        first_slot += len(shapes.nearest)
    distance, slot = nearest
    return distance.reshape(limit.shape[0], -1), slot.reshape(limit.shape[0], -1)


def _nearest_of_kind(
    rays: Vectors, candidates: Candidates, first_slot: int, solid: Solid, nearest: Nearest, chance: Chance
) -> Nearest:
    """Updates the `nearest` hits with one kind of shapes, whose first slot has the number `first_slot`.

    `rays` are (lasers, sectors, columns).
    """
    slots = len(candidates.nearest)
    pore_factors = jnp.asarray(_PORE_FACTORS[first_slot : first_slot + slots])

    def is_unfinished(state: tuple[Array, Nearest]) -> Array:
        slot, (distance, _) = state
        lower_bound = candidates.nearest[jnp.minimum(slot, slots - 1)]  # of this slot and all later ones
        return (slot < slots) & jnp.any(lower_bound < distance.max(axis=(0, 2)))

    def test_slot(slot: Array, nearest: Nearest) -> Nearest:
        shape = jax.tree.map(lambda array: array[slot][None, :, None], candidates)
        distance, nearest_slot = nearest
        enter, leave = solid(shape.origin, into_unit_frame(rays, shape))
        passes_through = chance.pores * pore_factors[slot] < shape.porosity
        hit = enter + shape.roughness * chance.depth
        is_closer = (enter > 0) & (hit <= leave) & (hit < distance) & ~passes_through
        return jnp.where(is_closer, hit, distance), jnp.where(is_closer, first_slot + slot, nearest_slot)

    def test_slots(state: tuple[Array, Nearest]) -> tuple[Array, Nearest]:
        slot, nearest = state
        for i in range(UNROLL):
            nearest = test_slot(slot + i, nearest)
        return slot + UNROLL, nearest

    return jax.lax.while_loop(is_unfinished, test_slots, (jnp.int32(0), nearest))[1]


_REFLECTIVITY = np.full(260, 0.35, np.float32)  # by raw label id
for _id, _value in {
    labels.NO_RETURN: 0.0,
    labels.ROAD: 0.25,
    labels.PARKING: 0.25,
    labels.LANE_MARKING: 0.6,
    labels.BUILDING: 0.4,
    labels.CAR: 0.3,
    labels.MOVING[labels.CAR]: 0.3,
    labels.TRAFFIC_SIGN: 0.95,
}.items():
    _REFLECTIVITY[_id] = _value


class Surface(NamedTuple):
    """Surface hit by each ray. Every array is (lasers, azimuths)."""

    distance: Array  # metres; the maximum range without a hit
    label: Array  # int32 raw ids
    facing: Array  # cosine of the angle between ray and normal
    window: Array  # bool, whether the ray hits a window


def surface_of_shapes(
    rays: Vectors, distance: PerRay, slot: Int[Array, "lasers azimuths"], candidates: Sequence[Candidates]
) -> Surface:
    """Surface that each ray hits at `distance` on the shape in `slot`, which counts boxes, cylinders, then ellipsoids.

    If `slot` is -1, the result is arbitrary.
    """
    first_cylinder, first_ellipsoid = np.cumsum([len(kind.nearest) for kind in candidates])[:2]
    sectors = candidates[0].nearest.shape[1]
    row = jnp.maximum(slot, 0) * sectors + (jnp.arange(slot.shape[1]) // COLUMNS)[None, :]
    table = jax.tree.map(lambda *kinds: jnp.concatenate(kinds).reshape(-1), *candidates)  # rows (slots * sectors,)
    shape = jax.tree.map(lambda column: jnp.take(column, row, mode="clip"), table)

    direction = into_unit_frame(rays, shape)
    point = Vectors(*(o + distance * d for o, d in zip(shape.origin, direction, strict=True)))
    normal = _normal(point, is_box=slot < first_cylinder, is_ball=slot >= first_ellipsoid)
    half_x, half_y = jax.lax.rsqrt(shape.xx**2 + shape.xy**2), jax.lax.rsqrt(shape.yx**2 + shape.yy**2)
    length = jnp.sqrt((normal.x / half_x) ** 2 + (normal.y / half_y) ** 2 + (normal.z * shape.zz) ** 2)
    cosine = normal.x * direction.x + normal.y * direction.y + normal.z * direction.z
    facing = jnp.abs(cosine) / jnp.maximum(length, 1e-9)

    along_facade_m = jnp.where(jnp.abs(point.x) > jnp.abs(point.y), point.y * half_y, point.x * half_x)
    window = _in_window(along_facade_m, (point.z + 1) / shape.zz, shape.glass)
    return Surface(distance, shape.label, jnp.where(shape.roughness > 0, LEAF_FACING, facing), window)


def _normal(point: Vectors, *, is_box: Array, is_ball: Array) -> Vectors:
    """Normal, of any length, of a unit solid at a point of its surface. Other solids are cylinders."""
    x, y, z = (jnp.abs(axis) for axis in point)
    of_box = Vectors((x >= y) & (x >= z), (y > x) & (y >= z), (z > x) & (z > y))
    on_cap = x**2 + y**2 < z**2
    of_cylinder = Vectors(jnp.where(on_cap, 0, point.x), jnp.where(on_cap, 0, point.y), jnp.where(on_cap, 1, 0))
    axes = zip(point, of_box, of_cylinder, strict=True)  # the normal of a ball is the point itself
    return Vectors(*(jnp.where(is_box, box, jnp.where(is_ball, ball, cylinder)) for ball, box, cylinder in axes))


def _in_window(along_m: Array, up_m: Array, glass: Array) -> Bool[Array, "lasers azimuths"]:
    """Whether a position on a facade is in a window. Each bay of each storey has a window in its middle.

    `glass` is the fraction of the facade that is window.
    """
    half_side = jnp.sqrt(glass) / 2  # as a fraction of the bay's width or the storey's height
    from_middle, from_mid_height = jnp.abs(along_m / BAY_M % 1 - 0.5), jnp.abs(up_m / STOREY_M % 1 - 0.5)
    return (from_middle < half_side) & (from_mid_height < half_side)


def reflectivity(label: Int[Array, "lasers azimuths"]) -> PerRay:
    """Fraction of the light that a surface with this label reflects, from 0 to 1."""
    return jnp.asarray(_REFLECTIVITY)[label]


def echo_returns(
    chance: PerRay, surface: Surface, *, faintest_echo: float, dropout: float
) -> Bool[Array, "lasers azimuths"]:
    """Whether the echo of each ray is detected. `chance` is uniform in [0, 1).

    An echo of strength e = reflectivity x facing / distance^2 is detected with probability
    1 - exp(-(e / faintest_echo)^2), reduced by `dropout` and by windows. A flat road vanishes between 35 and 55 m.
    """
    echo = reflectivity(surface.label) * surface.facing / jnp.maximum(surface.distance, 1) ** 2
    detected = (1 - dropout) * -jnp.expm1(-((echo / faintest_echo) ** 2))
    return chance < jnp.where(surface.window, 1 - WINDOW_LOSS, 1) * detected


def mix_edges(chance: PerRay, reach: PerRay, returned: Bool[Array, "lasers azimuths"], *, share: float) -> PerRay:
    """Replaces the fraction `share` of the ranges `reach` by random ranges between them and that of the next azimuth.

    Both rays must return, with ranges that differ by less than EDGE_JUMP_M. `chance` is uniform in [0, 1).
    """
    jump = jnp.roll(reach, -1, axis=1) - reach
    is_mixed = returned & jnp.roll(returned, -1, axis=1) & (jnp.abs(jump) < EDGE_JUMP_M) & (chance < share)
    return jnp.where(is_mixed, reach + jump * (chance / max(share, 1e-6)), reach)  # chance / share is in [0, 1)
