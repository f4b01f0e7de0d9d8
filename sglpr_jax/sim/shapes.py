"""What stands and moves in a world: upright boxes, cylinders and ellipsoids, each turned about z only.

A shape is a unit solid (cube, cylinder, ball) that is scaled by its half sizes, turned by its yaw and moved to its
centre. All three solids are convex, so a ray is inside one of them during one interval of its length, and the hit is
where that interval begins. Every interval comes from one or two simpler ones: a cube is the meeting of three slabs, a
cylinder that of a disc and a slab.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

AnyArray = Array | np.ndarray
Interval = tuple[AnyArray, AnyArray]
"""Where a ray enters and where it leaves a solid; enter > leave where it misses."""


class Shapes(NamedTuple):
    """Shapes of one kind in the world frame; every array has the leading axis n."""

    centre: AnyArray  # (n, 3) metres, at time 0: a mover's centre at time t is centre[:, :2] + velocity * t
    half: AnyArray  # (n, 3) half sizes along the shape's own axes, metres
    yaw: AnyArray  # (n,) rotation about z, radians
    label: AnyArray  # (n,) int32 raw SemanticKITTI ids
    roughness: AnyArray  # (n,) metres: mean depth that a ray goes into it before it returns; leaves are no wall
    porosity: AnyArray  # (n,) share 0..1 of the rays that pass as if it were not there: crowns, fences of mesh
    glass: AnyArray  # (n,) share 0..1 of a facade that is window; a window returns nothing most of the time
    velocity: AnyArray  # (n, 2) m/s, zero for all that stands
    since: AnyArray  # (n,) seconds: the shape is there for since <= time < until; -inf and inf: always
    until: AnyArray  # (n,)


class Scene(NamedTuple):
    """Everything on the ground. The ground itself is no shape."""

    boxes: Shapes
    cylinders: Shapes
    ellipsoids: Shapes


class Vectors(NamedTuple):
    """Vectors as three arrays, one per axis, that broadcast against each other.

    This is several times faster than one (n, 3) array: no axis of length 3 takes part in the arithmetic.
    """

    x: AnyArray
    y: AnyArray
    z: AnyArray


Solid = Callable[[Vectors, Vectors], Interval]
"""Of origins and directions in a solid's unit frame: the interval of every ray inside the solid."""


def at_time(shapes: Shapes, time: float, near: Float[np.ndarray, "3"], *, reach_m: float) -> Shapes:
    """Return the shapes that are there at `time` and less than `reach_m` from `near`, where they are then."""
    velocity = np.asarray(shapes.velocity)
    centre = np.concatenate([shapes.centre[:, :2] + velocity * time, shapes.centre[:, 2:]], axis=1)
    present = (shapes.since <= time) & (time < shapes.until)
    close = np.linalg.norm(centre - near, axis=1) < reach_m + np.linalg.norm(shapes.half, axis=1)
    chosen = np.flatnonzero(present & close)
    return Shapes(*(np.asarray(values)[chosen] for values in shapes._replace(centre=centre)))


def _slab(origin: AnyArray, direction: AnyArray) -> Interval:
    """The part of a ray with |origin + t direction| <= 1, along one axis."""
    inverse = 1 / jnp.where(jnp.abs(direction) < 1e-9, 1e-9, direction)
    return -origin * inverse - jnp.abs(inverse), -origin * inverse + jnp.abs(inverse)


def _round(square: AnyArray, towards: AnyArray, discriminant: AnyArray) -> Interval:
    """The part of a ray with |o + t d| <= 1, from |d|^2, o.d and (o.d)^2 - |d|^2 (|o|^2 - 1)."""
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    enter = jnp.where(discriminant < 0, jnp.inf, (-towards - root) / square)
    return enter, (root - towards) / square


def _both(a: Interval, b: Interval) -> Interval:
    """The part that two intervals share."""
    return jnp.maximum(a[0], b[0]), jnp.minimum(a[1], b[1])


def cube(o: Vectors, d: Vectors) -> Interval:
    """Where rays are in |x|, |y|, |z| <= 1."""
    return _both(_both(_slab(o.x, d.x), _slab(o.y, d.y)), _slab(o.z, d.z))


def cylinder(o: Vectors, d: Vectors) -> Interval:
    """Where rays are in x^2 + y^2 <= 1, |z| <= 1."""
    square = jnp.maximum(d.x**2 + d.y**2, 1e-12)
    # The same discriminant, but float32 keeps this form for a thin pole far away too.
    discriminant = square - (o.x * d.y - o.y * d.x) ** 2
    return _both(_round(square, o.x * d.x + o.y * d.y, discriminant), _slab(o.z, d.z))


def ball(o: Vectors, d: Vectors) -> Interval:
    """Where rays are in x^2 + y^2 + z^2 <= 1."""
    square, towards = d.x**2 + d.y**2 + d.z**2, o.x * d.x + o.y * d.y + o.z * d.z
    return _round(square, towards, towards**2 - square * (o.x**2 + o.y**2 + o.z**2 - 1))


SOLIDS: tuple[Solid, Solid, Solid] = (cube, cylinder, ball)
"""The solids of boxes, cylinders and ellipsoids, in this order."""
