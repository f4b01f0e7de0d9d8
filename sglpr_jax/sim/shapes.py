"""What a ray meets: upright boxes, cylinders and ellipsoids, each turned about z only.

A shape is a unit solid (cube, cylinder, ball) that is scaled by its half sizes, turned by its yaw and moved to its
centre. All three solids are convex, so a ray is inside one of them during one interval of its length, and the hit is
where that interval begins. Every interval comes from one or two simpler ones: a cube is the meeting of three slabs, a
cylinder that of a disc and a slab.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

AnyArray = Array | np.ndarray
Interval = tuple[AnyArray, AnyArray]
"""Where a ray enters and where it leaves a solid; enter > leave where it misses."""


class Shapes(NamedTuple):
    """Shapes of one kind; every array has the leading axis n."""

    centre: AnyArray  # (n, 3) metres
    half: AnyArray  # (n, 3) half sizes along the shape's own axes, metres
    yaw: AnyArray  # (n,) rotation about z, radians
    label: AnyArray  # (n,) raw SemanticKITTI ids
    roughness: AnyArray  # (n,) how far returns scatter along the ray, metres: leaves are no wall


class Scene(NamedTuple):
    """Everything that stands on the ground."""

    boxes: Shapes
    cylinders: Shapes
    ellipsoids: Shapes


class Vectors(NamedTuple):
    """Vectors as three arrays, one per axis, that broadcast against each other.

    This is several times faster than one (n, 3) array. A spinning sensor gives x and y by azimuth and z by elevation,
    so that most of the work is done once per azimuth or once per elevation instead of once per ray.
    """

    x: AnyArray
    y: AnyArray
    z: AnyArray


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


def _cube(o: Vectors, d: Vectors) -> Interval:
    return _both(_both(_slab(o.x, d.x), _slab(o.y, d.y)), _slab(o.z, d.z))


def _cylinder(o: Vectors, d: Vectors) -> Interval:
    square = d.x**2 + d.y**2
    # The same discriminant, but float32 keeps this form for a thin pole far away too.
    discriminant = square - (o.x * d.y - o.y * d.x) ** 2
    return _both(_round(square, o.x * d.x + o.y * d.y, discriminant), _slab(o.z, d.z))


def _ball(o: Vectors, d: Vectors) -> Interval:
    square, towards = d.x**2 + d.y**2 + d.z**2, o.x * d.x + o.y * d.y + o.z * d.z
    return _round(square, towards, towards**2 - square * (o.x**2 + o.y**2 + o.z**2 - 1))


def _in_unit_frame(vectors: Vectors, shape: Shapes) -> Vectors:
    """The same vectors along the axes and in the half sizes of `shape`, a single one."""
    cos, sin = jnp.cos(shape.yaw), jnp.sin(shape.yaw)
    along, across = cos * vectors.x + sin * vectors.y, cos * vectors.y - sin * vectors.x
    return Vectors(along / shape.half[0], across / shape.half[1], vectors.z / shape.half[2])


Nearest = tuple[Array, Array]
"""Of every ray: the distance to the nearest hit so far, and the index of the shape that was hit."""


def _nearest_of_kind(
    rays: Vectors, shapes: Shapes, first: int, solid: Callable[[Vectors, Vectors], Interval], best: Nearest
) -> Nearest:
    """`best` after every ray has been tried against `shapes`, whose indices begin at `first`."""

    def try_shape(best: Nearest, indexed: tuple[Shapes, Array]) -> tuple[Nearest, None]:
        shape, index = indexed
        origin = _in_unit_frame(Vectors(*-shape.centre), shape)
        enter, leave = solid(origin, _in_unit_frame(rays, shape))
        distance, nearest = best
        closer = (enter <= leave) & (enter > 0) & (enter < distance)
        return (jnp.where(closer, enter, distance), jnp.where(closer, index, nearest)), None

    indices = first + jnp.arange(len(shapes.label), dtype=jnp.int32)
    return jax.lax.scan(try_shape, best, (shapes, indices), unroll=4)[0]


def nearest_hit(rays: Vectors, scene: Scene) -> tuple[Float[Array, "*rays"], Int[Array, "*rays"]]:
    """Distance to the first shape that each ray from the origin meets, and which one it is.

    Distances count in lengths of the ray's direction, which need not be 1. The index counts boxes, then cylinders, then
    ellipsoids; a ray that meets nothing has distance inf and index -1. A shape around the rays' origin is not seen.
    """
    shape = jnp.broadcast_shapes(*(axis.shape for axis in rays))
    best = jnp.full(shape, jnp.inf, jnp.float32), jnp.full(shape, -1, jnp.int32)
    first = 0
    for shapes, solid in zip(scene, (_cube, _cylinder, _ball), strict=True):
        best = _nearest_of_kind(rays, shapes, first, solid, best)
        first += len(shapes.label)
    return best
