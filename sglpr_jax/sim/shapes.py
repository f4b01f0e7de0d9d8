"""Standing and moving shapes of a world: boxes, cylinders and ellipsoids, rotated only about z.

A shape is a unit solid (cube, cylinder or ball), scaled by its half sizes, rotated by its yaw and moved to its centre.
Solids are convex, so a ray is inside for one interval. Its start is the hit.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

AnyArray = Array | np.ndarray
Interval = tuple[AnyArray, AnyArray]
"""Distances at which a ray enters and leaves a solid. If the ray misses the solid, enter > leave."""


class Shapes(NamedTuple):
    """Shapes of one kind in the world frame. The first axis of every array has length n."""

    centre: AnyArray  # (n, 3) metres, at time 0; at time t, x and y are centre[:, :2] + velocity * t
    half: AnyArray  # (n, 3) half sizes along the shape's own axes, metres
    yaw: AnyArray  # (n,) rotation about z, radians
    label: AnyArray  # (n,) int32 raw SemanticKITTI ids
    roughness: AnyArray  # (n,) mean depth inside the shape at which a ray returns, metres; for example leaves
    porosity: AnyArray  # (n,) fraction of the rays that pass through the shape, 0 to 1: crowns, mesh fences
    glass: AnyArray  # (n,) fraction of a facade that is window, 0 to 1; most rays into a window do not return
    velocity: AnyArray  # (n, 2) m/s, zero for standing shapes
    since: AnyArray  # (n,) seconds; the shape is present for since <= time < until, -inf to inf means always
    until: AnyArray  # (n,) seconds


class Scene(NamedTuple):
    """All shapes of a world, without the ground."""

    boxes: Shapes
    cylinders: Shapes
    ellipsoids: Shapes


class Vectors(NamedTuple):
    """Vectors as one array per axis, which broadcast. This is several times faster than one (n, 3) array."""

    x: AnyArray
    y: AnyArray
    z: AnyArray


Solid = Callable[[Vectors, Vectors], Interval]
"""Function of origins and directions in a solid's unit frame that returns the interval of each ray in the solid."""


def at_time(shapes: Shapes, time: float, sensor_xyz: Float[np.ndarray, "3"], *, reach_m: float) -> Shapes:
    """Returns the shapes present at `time` (seconds) within `reach_m` of the sensor, with the centres at that time."""
    velocity = np.asarray(shapes.velocity)
    centre = np.concatenate([shapes.centre[:, :2] + velocity * time, shapes.centre[:, 2:]], axis=1)
    is_present = (shapes.since <= time) & (time < shapes.until)
    is_near = np.linalg.norm(centre - sensor_xyz, axis=1) < reach_m + np.linalg.norm(shapes.half, axis=1)
    rows = np.flatnonzero(is_present & is_near)
    return Shapes(*(np.asarray(column)[rows] for column in shapes._replace(centre=centre)))


def _interval_in_slab(origin: AnyArray, direction: AnyArray) -> Interval:
    """Interval of t with |origin + t * direction| <= 1, for the coordinates of a ray along one axis."""
    inverse = 1 / jnp.where(jnp.abs(direction) < 1e-9, 1e-9, direction)
    return -origin * inverse - jnp.abs(inverse), -origin * inverse + jnp.abs(inverse)


def _interval_in_ball(square: AnyArray, product: AnyArray, discriminant: AnyArray) -> Interval:
    """Interval of t with |o + t d| <= 1, from |d|^2, the dot product o.d and (o.d)^2 - |d|^2 (|o|^2 - 1)."""
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    enter = jnp.where(discriminant < 0, jnp.inf, (-product - root) / square)
    return enter, (root - product) / square


def _intersection(a: Interval, b: Interval) -> Interval:
    return jnp.maximum(a[0], b[0]), jnp.minimum(a[1], b[1])


def cube(o: Vectors, d: Vectors) -> Interval:
    """Intervals of rays from the origin `o` in the direction `d` inside |x|, |y|, |z| <= 1."""
    in_xy = _intersection(_interval_in_slab(o.x, d.x), _interval_in_slab(o.y, d.y))
    return _intersection(in_xy, _interval_in_slab(o.z, d.z))


def cylinder(o: Vectors, d: Vectors) -> Interval:
    """Intervals of rays from the origin `o` in the direction `d` inside x^2 + y^2 <= 1, |z| <= 1."""
    square = jnp.maximum(d.x**2 + d.y**2, 1e-12)
    # Equal to the usual discriminant, but accurate in float32 even for a thin pole far away.
    discriminant = square - (o.x * d.y - o.y * d.x) ** 2
    in_xy = _interval_in_ball(square, o.x * d.x + o.y * d.y, discriminant)
    return _intersection(in_xy, _interval_in_slab(o.z, d.z))


def ball(o: Vectors, d: Vectors) -> Interval:
    """Intervals of rays from the origin `o` in the direction `d` inside x^2 + y^2 + z^2 <= 1."""
    square, product = d.x**2 + d.y**2 + d.z**2, o.x * d.x + o.y * d.y + o.z * d.z
    return _interval_in_ball(square, product, product**2 - square * (o.x**2 + o.y**2 + o.z**2 - 1))


SOLIDS: tuple[Solid, Solid, Solid] = (cube, cylinder, ball)  # solids of boxes, cylinders and ellipsoids, in this order
