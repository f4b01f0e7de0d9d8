"""First hit of each ray with a shape, and whether it returns: surfaces, windows, weak echoes and mixed edges.

The host lists the shapes in each sector of columns, nearest first. The device tests one shape per sector at a time,
until the remaining shapes are farther than all hits.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sglpr_jax.sim import labels
from sglpr_jax.sim.shapes import SOLIDS, AnyArray, Scene, Shapes, Solid, Vectors, at_time

COLUMNS = 32  # number of azimuth steps in a sector
SLOTS = 64, 48, 128  # maximum numbers of boxes, cylinders and ellipsoids in a sector; the nearest are kept
UNROLL = 2  # shapes tested between two checks of the stop condition; it divides all numbers of slots
_MARGIN = 1e-3
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

    A shape is given by the transformation to its unit frame, from the frame at the sensor with the world's axes.
    """

    xx: AnyArray  # unit x = xx x + xy y + origin x, likewise for y and z; 1 / metres
    xy: AnyArray
    yx: AnyArray
    yy: AnyArray
    zz: AnyArray
    origin: Vectors  # position of the sensor in the unit frame
    nearest: AnyArray  # lower bound of the distance from the sensor, metres; inf in an empty slot
    roughness: AnyArray
    porosity: AnyArray  # uint32, as a fraction of 2^32
    glass: AnyArray
    label: AnyArray  # int32


class Chance(NamedTuple):
    """Random numbers for each ray."""

    depth: AnyArray  # exponentially distributed with mean 1: depth at which a rough shape returns the ray
    pores: AnyArray  # uint32, uniform: selects the porous shapes that the ray passes


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
    slots: tuple[int, ...] = SLOTS,
) -> tuple[Candidates, ...]:
    """Lists the boxes, cylinders and ellipsoids within `reach_m` that the rays of each sector may hit at `time`."""
    first, last = np.radians(azimuths_deg)
    step = (last - first) / azimuth_steps
    middle = first + (np.arange(sector_count(azimuth_steps)) * COLUMNS + (COLUMNS - 1) / 2) * step
    half_width = (COLUMNS - 1) / 2 * step + _MARGIN
    candidates = []
    for shapes, count in zip(scene, slots, strict=True):
        present = at_time(shapes, time, world_from_lidar[:3, 3], reach_m=reach_m)
        bearing, half_extent = _bearings(present, world_from_lidar)
        angle = np.abs(_wrapped(bearing[:, None] - middle))
        candidates.append(_listed(present, world_from_lidar[:3, 3], angle <= half_extent[:, None] + half_width, count))
    return tuple(candidates)


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """Wraps angles to [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _bearings(shapes: Shapes, world_from_lidar: Float[np.ndarray, "4 4"]) -> tuple[np.ndarray, np.ndarray]:
    """Middle and half width of the azimuth interval of each shape, in the LiDAR frame."""
    signs = np.stack(np.meshgrid(*[(-1, 1)] * 3), axis=-1).reshape(-1, 3)
    corners = signs * shapes.half[:, None]
    cos, sin = np.cos(shapes.yaw)[:, None], np.sin(shapes.yaw)[:, None]
    offset = shapes.centre - world_from_lidar[:3, 3]
    turned = np.stack([cos * corners[..., 0] - sin * corners[..., 1], sin * corners[..., 0] + cos * corners[..., 1]])
    corners = np.concatenate([np.moveaxis(turned, 0, -1), corners[..., 2:]], axis=-1) + offset[:, None]

    azimuth = np.arctan2(*np.moveaxis(corners @ world_from_lidar[:3, 1::-1], -1, 0))
    centre = np.arctan2(*(offset @ world_from_lidar[:3, 1::-1]).T)
    side = _wrapped(azimuth - centre[:, None])
    low, high = side.min(axis=1), side.max(axis=1)
    # A shape that spans half a revolution or more is around, above or below the sensor, so any ray may hit it.
    return centre + (low + high) / 2, np.where(high - low < np.pi, (high - low) / 2, np.pi)


def _listed(shapes: Shapes, sensor: Float[np.ndarray, "3"], overlap: np.ndarray, slots: int) -> Candidates:
    """Nearest `slots` shapes of each sector, among the shapes with a true `overlap` (n, sectors)."""
    cos, sin, offset = np.cos(shapes.yaw), np.sin(shapes.yaw), shapes.centre - sensor
    along, across = cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0]
    inside = np.stack([along, across, offset[:, 2]], axis=1)
    nearest = np.linalg.norm(np.maximum(np.abs(inside) - shapes.half, 0), axis=1)

    order = np.argsort(nearest, kind="stable")
    slot = np.cumsum(overlap[order], axis=0) - 1
    which, sector = np.nonzero(overlap[order] & (slot < slots))
    table = np.full((slots, overlap.shape[1]), -1)
    table[slot[which, sector], sector] = order[which]

    def fill(values: AnyArray, empty: float, dtype: type = np.float32) -> np.ndarray:
        return np.append(values, empty)[table].astype(dtype)

    (hx, hy, hz), origin = shapes.half.T, -inside / shapes.half
    return Candidates(
        xx=fill(cos / hx, 1.0),
        xy=fill(sin / hx, 0.0),
        yx=fill(-sin / hy, 0.0),
        yy=fill(cos / hy, 1.0),
        zz=fill(1 / hz, 1.0),
        origin=Vectors(*(fill(axis, 1e6) for axis in origin.T)),  # 1000 km away, so never hit
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

    Slots count boxes, then cylinders, then ellipsoids. Without a hit nearer than `limit`, they are `limit` and -1.
    Shapes around the sensor are not hit. A rough shape returns a ray from a random depth, if it is not thinner.
    """
    sectors = (limit.shape[0], -1, COLUMNS)
    rays, limit, chance = jax.tree.map(
        lambda values: jnp.broadcast_to(values, limit.shape).reshape(sectors), (rays, limit, chance)
    )
    best, first = (limit, jnp.full(limit.shape, -1, jnp.int32)), 0
    for kind, solid in zip(jax.tree.map(jnp.asarray, candidates), SOLIDS, strict=True):
        best = _nearest_of_kind(rays, kind, first, solid, best, chance)
        first += len(kind.nearest)
    distance, slot = best
    return distance.reshape(limit.shape[0], -1), slot.reshape(limit.shape[0], -1)


def _nearest_of_kind(
    rays: Vectors, candidates: Candidates, first: int, solid: Solid, best: Nearest, chance: Chance
) -> Nearest:
    """Updates `best` with one kind of shapes. `rays` are (lasers, sectors, columns), and slots begin at `first`."""
    slots = len(candidates.nearest)
    pore_factors = jnp.asarray(_PORE_FACTORS[first : first + slots])

    def unfinished(state: tuple[Array, Nearest]) -> Array:
        slot, (distance, _) = state
        nearest = candidates.nearest[jnp.minimum(slot, slots - 1)]
        return (slot < slots) & jnp.any(nearest < distance.max(axis=(0, 2)))

    def try_slot(slot: Array, best: Nearest) -> Nearest:
        shape = jax.tree.map(lambda values: values[slot][None, :, None], candidates)
        distance, hit = best
        enter, leave = solid(shape.origin, into_unit_frame(rays, shape))
        through = chance.pores * pore_factors[slot] < shape.porosity
        met = enter + shape.roughness * chance.depth
        closer = (enter > 0) & (met <= leave) & (met < distance) & ~through
        return jnp.where(closer, met, distance), jnp.where(closer, first + slot, hit)

    def try_some(state: tuple[Array, Nearest]) -> tuple[Array, Nearest]:
        slot, best = state
        for i in range(UNROLL):
            best = try_slot(slot + i, best)
        return slot + UNROLL, best

    return jax.lax.while_loop(unfinished, try_some, (jnp.int32(0), best))[1]


_REFLECTIVITY = np.full(260, 0.35, np.float32)
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
    """Surface that each ray hits at `distance` on the shape in `slot`. If `slot` is -1, the values are arbitrary."""
    first_cylinder, first_ellipsoid = np.cumsum([len(kind.nearest) for kind in candidates])[:2]
    sectors = candidates[0].nearest.shape[1]
    row = jnp.maximum(slot, 0) * sectors + (jnp.arange(slot.shape[1]) // COLUMNS)[None, :]
    joined = jax.tree.map(lambda *kinds: jnp.concatenate(kinds).reshape(-1), *candidates)
    shape = jax.tree.map(lambda values: jnp.take(values, row, mode="clip"), joined)

    towards = into_unit_frame(rays, shape)
    at = Vectors(*(o + distance * d for o, d in zip(shape.origin, towards, strict=True)))
    normal = _normal(at, is_box=slot < first_cylinder, is_ball=slot >= first_ellipsoid)
    width, depth = jax.lax.rsqrt(shape.xx**2 + shape.xy**2), jax.lax.rsqrt(shape.yx**2 + shape.yy**2)
    length = jnp.sqrt((normal.x / width) ** 2 + (normal.y / depth) ** 2 + (normal.z * shape.zz) ** 2)
    facing = jnp.abs(normal.x * towards.x + normal.y * towards.y + normal.z * towards.z) / jnp.maximum(length, 1e-9)

    along = jnp.where(jnp.abs(at.x) > jnp.abs(at.y), at.y * depth, at.x * width)
    window = _in_window(along, (at.z + 1) / shape.zz, shape.glass)
    return Surface(distance, shape.label, jnp.where(shape.roughness > 0, LEAF_FACING, facing), window)


def _normal(at: Vectors, *, is_box: Array, is_ball: Array) -> Vectors:
    """Normal of any length of a unit solid at the point `at`."""
    x, y, z = (jnp.abs(axis) for axis in at)
    box = Vectors((x >= y) & (x >= z), (y > x) & (y >= z), (z > x) & (z > y))
    cap = x**2 + y**2 < z**2
    rod = Vectors(jnp.where(cap, 0, at.x), jnp.where(cap, 0, at.y), jnp.where(cap, 1, 0))
    return Vectors(*(jnp.where(is_box, b, jnp.where(is_ball, a, r)) for a, b, r in zip(at, box, rod, strict=True)))


def _in_window(along: Array, up: Array, glass: Array) -> Bool[Array, "lasers azimuths"]:
    """Whether a position on a facade is in a window. Each bay of each storey has one window in its middle."""
    half_side = jnp.sqrt(glass) / 2
    beside, above = (jnp.abs(place / size % 1 - 0.5) for place, size in ((along, BAY_M), (up, STOREY_M)))
    return (beside < half_side) & (above < half_side)


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
    """Replaces the fraction `share` of the ranges by random values between them and the range of the next azimuth.

    Both rays must return, with ranges that differ by less than EDGE_JUMP_M. `chance` is uniform in [0, 1).
    """
    jump = jnp.roll(reach, -1, axis=1) - reach
    mixed = returned & jnp.roll(returned, -1, axis=1) & (jnp.abs(jump) < EDGE_JUMP_M) & (chance < share)
    return jnp.where(mixed, reach + jump * (chance / max(share, 1e-6)), reach)
