"""How SSC lays one scan onto another: a turn and a move of the outlines of their landmarks, in the plane."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

SECTORS = 360
WINDOW = np.arange(-10, 10)
"""Sectors in which a landmark's partner is sought, counted from its own."""
GATE_M = 3.0
"""Partners that are farther apart in x or in y do not count."""
STEPS = 100
"""Of the iterative closest point method, at most."""
STANDSTILL_M = 1e-5
"""It ends when a step is shorter in x and in y."""
FARTHEST_MOVE_M = 5.0
"""A move that is longer in x or in y is taken for a failure."""


def align(query: Float[Array, "2 360"], other: Float[Array, "2 360"]) -> tuple[Int[Array, ""], Float[Array, "2"]]:
    """Return by how many degrees to turn the scan `other` clockwise, and then how far to move it (x, y in metres).

    Outlines are x and y of the landmark of each sector, in metres; both are 0 where there is none. A move of more than
    5 m in x or in y is given up: it becomes 0.
    """
    shift = best_shift(jnp.hypot(*query), jnp.hypot(*other))
    turned = turn(jnp.roll(other, -shift, axis=1), shift)
    move = best_move(query, turned)
    return shift, jnp.where(jnp.all(jnp.abs(move) <= FARTHEST_MOVE_M), move, 0.0)


def best_shift(query: Float[Array, "360"], other: Float[Array, "360"]) -> Int[Array, ""]:
    """Return the s of least sum over j of |query[j] - other[j + s]|, distances in metres: of equal ones the first."""
    doubled = jnp.concatenate([other, other])
    costs = jax.lax.map(
        lambda s: jnp.abs(query - jax.lax.dynamic_slice(doubled, (s,), (SECTORS,))).sum(), jnp.arange(SECTORS)
    )
    return jnp.argmin(costs)


def turn(points: Float[Array, "2 n"], degrees: Int[Array, ""]) -> Float[Array, "2 n"]:
    """Return x and y after a clockwise turn."""
    cos, sin = jnp.cos(jnp.radians(degrees)), jnp.sin(jnp.radians(degrees))
    x, y = points
    return jnp.stack([x * cos + y * sin, y * cos - x * sin])


def best_move(query: Float[Array, "2 360"], other: Float[Array, "2 360"]) -> Float[Array, "2"]:
    """Return the move of `other` onto `query`, by the iterative closest point method in 2-D.

    Each landmark of the query is paired with the nearest in the 20 sectors about its own, of any class. The differences
    of the n pairs within 3 m in x and in y are added up, divided by n + 1, and added to the move, until that is less
    than 10 um or 100 times.
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
    """Return how far each point's nearest candidate is behind it in x and y; infinity where it has none."""

    def nearer(best, candidate):
        squared, apart = best
        to_candidate = points - candidate[0]
        found = jnp.where(candidate[1], jnp.sum(to_candidate**2, axis=0), jnp.inf)
        return (jnp.minimum(found, squared), jnp.where(found < squared, to_candidate, apart)), None

    start = jnp.full(SECTORS, jnp.inf), jnp.full((2, SECTORS), jnp.inf)
    # One candidate for all sectors at a time: the arrays stay small and the loop is plain arithmetic.
    return jax.lax.scan(nearer, start, (candidates, may_pair))[0][1]


def _is_landmark(outline: Float[Array, "2 360"]) -> Bool[Array, "360"]:
    return jnp.any(outline != 0, axis=0)
