"""Alignment of two scans in SSC: rotation and translation of their landmark outlines in the plane."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

SECTORS = 360
WINDOW = np.arange(-10, 10)
"""Sectors in which the partner of a landmark is searched, relative to its own sector."""
GATE_M = 3.0
"""Maximum distance of partners along x and along y, in metres."""
STEPS = 100
"""Maximum number of iterations of the iterative closest point method."""
STANDSTILL_M = 1e-5
"""The iteration stops when a step is shorter than this along x and along y, in metres."""
FARTHEST_MOVE_M = 5.0
"""Maximum translation along x and along y, in metres. Larger translations count as failures."""


def align(query: Float[Array, "2 360"], other: Float[Array, "2 360"]) -> tuple[Int[Array, ""], Float[Array, "2"]]:
    """Return the clockwise rotation of the scan `other`, in degrees, and then its translation (x, y), in metres.

    Outlines are x and y of the landmark in each sector, in metres. Both are 0 in sectors without a landmark. A
    translation of more than 5 m along x or y is replaced by 0.
    """
    shift = best_shift(jnp.hypot(*query), jnp.hypot(*other))
    turned = turn(jnp.roll(other, -shift, axis=1), shift)
    move = best_move(query, turned)
    return shift, jnp.where(jnp.all(jnp.abs(move) <= FARTHEST_MOVE_M), move, 0.0)


def best_shift(query: Float[Array, "360"], other: Float[Array, "360"]) -> Int[Array, ""]:
    """Return the s that minimises the sum over j of |query[j] - other[j + s]|, distances in metres; the first of equal
    ones."""
    doubled = jnp.concatenate([other, other])
    costs = jax.lax.map(
        lambda s: jnp.abs(query - jax.lax.dynamic_slice(doubled, (s,), (SECTORS,))).sum(), jnp.arange(SECTORS)
    )
    return jnp.argmin(costs)


def turn(points: Float[Array, "2 n"], degrees: Int[Array, ""]) -> Float[Array, "2 n"]:
    """Return x and y after a clockwise rotation."""
    cos, sin = jnp.cos(jnp.radians(degrees)), jnp.sin(jnp.radians(degrees))
    x, y = points
    return jnp.stack([x * cos + y * sin, y * cos - x * sin])


def best_move(query: Float[Array, "2 360"], other: Float[Array, "2 360"]) -> Float[Array, "2"]:
    """Return the translation of `other` onto `query`, by the iterative closest point method in 2-D.

    Each landmark of the query is paired with the nearest landmark of any class in the 20 sectors around its own. The
    step is the sum of the differences of the n pairs within 3 m along x and y, divided by n + 1. Steps are added until
    one is shorter than 10 um, at most 100 times.
    """
    partners = (np.arange(SECTORS) + WINDOW[:, None]) % SECTORS
    candidates = jnp.moveaxis(other[:, partners], 1, 0)
    may_pair = _is_landmark(query)[None, :] & _is_landmark(other)[partners]

    def step(state):
        move, _, count = state
        apart = _to_nearest(query - move[:, None], candidates, may_pair)
        near = jnp.all(jnp.abs(apart) < GATE_M, axis=0)
        by = jnp.where(near, apart, 0.0).sum(axis=1) / (1 + near.sum())
        return move + by, by, count + 1

    def goes_on(state):
        _, by, count = state
        return (count < STEPS) & jnp.any(jnp.abs(by) >= STANDSTILL_M)

    return jax.lax.while_loop(goes_on, step, (jnp.zeros(2), jnp.full(2, jnp.inf), 0))[0]


def _to_nearest(
    points: Float[Array, "2 360"], candidates: Float[Array, "20 2 360"], may_pair: Bool[Array, "20 360"]
) -> Float[Array, "2 360"]:
    """Return the offset in x and y from each point's nearest candidate to the point; infinity without a candidate."""

    def nearer(best, candidate):
        squared, apart = best
        to_candidate = points - candidate[0]
        found = jnp.where(candidate[1], jnp.sum(to_candidate**2, axis=0), jnp.inf)
        return (jnp.minimum(found, squared), jnp.where(found < squared, to_candidate, apart)), None

    start = jnp.full(SECTORS, jnp.inf), jnp.full((2, SECTORS), jnp.inf)
    # One candidate for all sectors at a time keeps the arrays small and the loop simple.
    return jax.lax.scan(nearer, start, (candidates, may_pair))[0][1]


def _is_landmark(outline: Float[Array, "2 360"]) -> Bool[Array, "360"]:
    return jnp.any(outline != 0, axis=0)
