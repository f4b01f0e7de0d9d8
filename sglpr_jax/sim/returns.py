"""Returns of the rays: surfaces and labels, windows, weak echoes and mixed edges."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sglpr_jax.sim import raw_ids
from sglpr_jax.sim.raycast import COLUMNS, Candidates, into_unit_frame
from sglpr_jax.sim.shapes import Vectors

STOREY_M, BAY_M = 3.0, 2.5
"""Height and width of a piece of facade with one window, in metres."""
WINDOW_LOSS = 0.9
"""Fraction of the rays into a window that do not return."""
LEAF_FACING = 0.5
"""Mean cosine of the angle between a ray and the normal of a leaf, for all rough shapes and all directions."""
EDGE_JUMP_M = 2.0
"""Distance above which the sensor separates two echoes, in metres. Closer echoes are mixed."""

_REFLECTIVITY = np.full(260, 0.35, np.float32)
for _id, _value in {
    raw_ids.NO_RETURN: 0.0,
    raw_ids.ROAD: 0.25,
    raw_ids.PARKING: 0.25,
    raw_ids.LANE_MARKING: 0.6,
    raw_ids.BUILDING: 0.4,
    raw_ids.CAR: 0.3,
    raw_ids.MOVING[raw_ids.CAR]: 0.3,
    raw_ids.TRAFFIC_SIGN: 0.95,
}.items():
    _REFLECTIVITY[_id] = _value


class Surface(NamedTuple):
    """Surface hit by each ray. Every array is (lasers, azimuths)."""

    distance: Array  # metres; the maximum range without a hit
    label: Array  # int32 raw ids
    facing: Array  # cosine of the angle between ray and normal
    window: Array  # bool, whether the ray hits a window


def surface_of_shapes(
    rays: Vectors,
    distance: Float[Array, "lasers azimuths"],
    slot: Int[Array, "lasers azimuths"],
    candidates: Sequence[Candidates],
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


def nearer(a: Surface, b: Surface) -> Surface:
    """Surface of `b` for each ray whose surface in `b` is nearer, otherwise that of `a`."""
    return jax.tree.map(lambda of_a, of_b: jnp.where(b.distance < a.distance, of_b, of_a), a, b)


def reflectivity(label: Int[Array, "lasers azimuths"]) -> Float[Array, "lasers azimuths"]:
    """Fraction of the light that a surface with this label reflects, from 0 to 1."""
    return jnp.asarray(_REFLECTIVITY)[label]


def echo_returns(
    chance: Float[Array, "lasers azimuths"], surface: Surface, *, faintest_echo: float, dropout: float
) -> Bool[Array, "lasers azimuths"]:
    """Whether the echo of each ray is detected. `chance` is uniform in [0, 1).

    The strength of an echo is e = reflectivity x facing / distance^2. It is detected with probability
    1 - exp(-(e / faintest_echo)^2), reduced by `dropout` and by windows. A flat road vanishes between 35 and 55 m, as
    in KITTI's scans. A wall vanishes at a much larger distance.
    """
    echo = reflectivity(surface.label) * surface.facing / jnp.maximum(surface.distance, 1) ** 2
    seen = (1 - dropout) * -jnp.expm1(-((echo / faintest_echo) ** 2))
    return chance < jnp.where(surface.window, 1 - WINDOW_LOSS, 1) * seen


def mix_edges(
    chance: Float[Array, "lasers azimuths"],
    reach: Float[Array, "lasers azimuths"],
    returned: Bool[Array, "lasers azimuths"],
    *,
    share: float,
) -> Float[Array, "lasers azimuths"]:
    """Replaces the fraction `share` of the ranges by random values between them and the range of the next azimuth.

    This models the width of beams. It requires that both rays returned and their ranges differ by less than
    EDGE_JUMP_M. `chance` is uniform in [0, 1).
    """
    jump = jnp.roll(reach, -1, axis=1) - reach
    mixed = returned & jnp.roll(returned, -1, axis=1) & (jnp.abs(jump) < EDGE_JUMP_M) & (chance < share)
    return jnp.where(mixed, reach + jump * (chance / max(share, 1e-6)), reach)
