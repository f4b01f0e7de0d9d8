"""SSC (Li et al., 2021): semantic classes on a polar grid, compared after one scan is laid onto the other."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int, Int32

from sglpr_jax.methods.method import HandcraftedMethod
from sglpr_jax.methods.pairwise import in_blocks

RINGS = 24
SECTORS = 360
NEAREST_M = 5.0
FARTHEST_M = 50.0
RING_M = (FARTHEST_M - NEAREST_M) / RINGS
PRIORITIES = (0, 0, 0, 0, 0, 0, 0, 0, 0, 10, 11, 12, 13, 15, 16, 14, 17, 9, 18, 19)
"""By class (`labels.CATEGORIES`): of the classes in a cell the one with the greatest stands for it; 0 is left out."""
LANDMARKS = (13, 14, 16, 18, 19)
"""Building, fence, trunk, pole and traffic sign: the classes whose outlines are laid on each other."""
CELLS = RINGS * SECTORS
NUMBERS = CELLS + 2 * SECTORS

WINDOW = 10
"""Sectors to either side in which a landmark's partner is sought."""
STEPS = 20
"""Of the iterative closest point method."""

BLOCK = 64


def ssc(points: Float32[np.ndarray, "n 3"], classes: Int32[np.ndarray, " n"]) -> Float32[np.ndarray, "9360"]:
    """Return the cells' priorities (24 x 360), then range (m) and class of each sector's nearest landmark; 0: none.

    Points are metres, x forward, y left, z up; classes are those of `labels.to_classes`. Rings divide 5 to 50 m evenly,
    sectors are degrees. Landmarks are taken from any range but 0.
    """
    x, y = points[:, :2].astype(np.float64).T
    radius = np.hypot(x, y)
    sector = np.floor(np.degrees(np.arctan2(y, x)) % 360).astype(np.int64) % SECTORS
    ring = np.floor((radius - NEAREST_M) / RING_M).astype(np.int64)
    inside = (ring >= 0) & (ring < RINGS)
    cells = np.zeros(CELLS)
    np.maximum.at(cells, (ring * SECTORS + sector)[inside], np.array(PRIORITIES)[classes[inside]])
    outline = _outline(radius, sector, classes)
    return np.concatenate([cells, *outline]).astype(np.float32)


def _outline(
    radius: Float[np.ndarray, " n"], sector: Int[np.ndarray, " n"], classes: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "2 360"]:
    """Return range and class of the nearest landmark of every sector, 0 where there is none."""
    found = np.flatnonzero(np.isin(classes, LANDMARKS) & (radius > 0))
    farthest_first = found[np.argsort(-radius[found], kind="stable")]
    outline = np.zeros((2, SECTORS))
    outline[:, sector[farthest_first]] = radius[farthest_first], classes[farthest_first]  # the last one written stays
    return outline


def ssc_distance(
    queries: Float32[np.ndarray, "q 9360"], database: Float32[np.ndarray, "n 9360"]
) -> Float32[np.ndarray, "q n"]:
    """Return 1 - (cells of equal class) / (cells empty in neither), after alignment; 1 where no cell is in both.

    Yaw: the shift s of the sectors with the least sum over j of |r_q(j) - r_d(j + s)|, r being the landmarks' ranges.
    Then the move in x and y, by the iterative closest point method in 2-D: each landmark of the database is paired with
    the nearest of its class within 10 sectors, and the mean difference is added to the move, 20 times. The published
    method divides the moved points into cells anew; here, where only cells are kept, each cell of the query is compared
    with the cell of the database in which its centre lies.
    """
    return in_blocks(_compare, queries, database, block=BLOCK, prepare=jnp.asarray)


@jax.jit
def _compare(queries: Float[Array, "q 9360"], database: Float[Array, "n 9360"]) -> Float[Array, "q n"]:
    """Return the distances of all pairs."""
    to_all = jax.vmap(_pair, in_axes=(None, 0))
    return jax.lax.map(lambda query: to_all(query, database), queries)


def _pair(query: Float[Array, "9360"], other: Float[Array, "9360"]) -> Float[Array, ""]:
    shift = best_shift(query[CELLS:-SECTORS], other[CELLS:-SECTORS])
    shifted = jnp.roll(other[CELLS:].reshape(2, SECTORS), -shift, axis=1)
    move = best_move(query[CELLS:].reshape(2, SECTORS), shifted)
    cells = jnp.roll(other[:CELLS].reshape(RINGS, SECTORS), -shift, axis=1)
    return 1 - similarity(query[:CELLS].reshape(RINGS, SECTORS), _look_up(cells, move))


def best_shift(query: Float[Array, "360"], other: Float[Array, "360"]) -> Int[Array, ""]:
    """Return the shift with which the ranges of `other` are most like those of `query`: of equal ones the first."""
    doubled = jnp.concatenate([other, other])
    costs = jax.lax.map(
        lambda s: jnp.abs(query - jax.lax.dynamic_slice(doubled, (s,), (SECTORS,))).sum(), jnp.arange(SECTORS)
    )
    return jnp.argmin(costs)


def best_move(query: Float[Array, "2 360"], other: Float[Array, "2 360"]) -> Float[Array, "2"]:
    """Return how far (x, y in metres) to move the landmarks of `other` onto those of `query`."""
    fixed, landmarks = _in_plane(query[0]), _in_plane(other[0])
    windows = (np.arange(-WINDOW, WINDOW + 1)[:, None] + np.arange(SECTORS)) % SECTORS
    may_pair = (query[1][windows] == other[1][None, :]) & (other[1] > 0)[None, :]

    def step(_, move):
        moved = landmarks + move[:, None]

        def nearer(best, candidate):
            squared, apart = best
            to_candidate = candidate[0] - moved
            found = jnp.where(candidate[1], jnp.sum(to_candidate**2, axis=0), jnp.inf)
            return (jnp.minimum(found, squared), jnp.where(found < squared, to_candidate, apart)), None

        start = jnp.full(SECTORS, jnp.inf), jnp.zeros_like(moved)
        # One candidate for all sectors at a time: the arrays stay small and the loop is plain arithmetic.
        (squared, apart), _ = jax.lax.scan(nearer, start, (jnp.moveaxis(fixed[:, windows], 1, 0), may_pair))
        return move + apart.sum(axis=1) / jnp.maximum(jnp.isfinite(squared).sum(), 1)

    return jax.lax.fori_loop(0, STEPS, step, jnp.zeros(2))


def similarity(a: Float[Array, "24 360"], b: Float[Array, "24 360"]) -> Float[Array, ""]:
    """Return the share of equal cells among those empty in neither; 0 where there are none."""
    both = (a > 0) & (b > 0)
    return jnp.sum(both & (a == b)) / jnp.maximum(both.sum(), 1)


def _in_plane(ranges: Float[Array, "360"]) -> Float[Array, "2 360"]:
    """Return x and y of a point in the middle of every sector."""
    return ranges[None, :] * _directions()


@functools.cache
def _directions() -> Float32[np.ndarray, "2 360"]:
    middle = np.radians(np.arange(SECTORS) + 0.5)
    return np.stack([np.cos(middle), np.sin(middle)]).astype(np.float32)


def _look_up(cells: Float[Array, "24 360"], move: Float[Array, "2"]) -> Float[Array, "24 360"]:
    """Return the cells of a scan after it was moved by `move` metres: for each the one in which its centre lay."""
    middle = NEAREST_M + RING_M * (np.arange(RINGS, dtype=np.float32) + 0.5)
    x, y = middle[:, None] * _directions()[:, None, :] - move[:, None, None]
    ring = jnp.floor((jnp.hypot(x, y) - NEAREST_M) / RING_M).astype(jnp.int32)
    sector = jnp.floor(jnp.arctan2(y, x) * (SECTORS / (2 * np.pi))).astype(jnp.int32) % SECTORS
    inside = (ring >= 0) & (ring < RINGS)
    return jnp.where(inside, cells[jnp.clip(ring, 0, RINGS - 1), sector], 0.0)


SSC = HandcraftedMethod(
    "ssc",
    'Li et al., "SSC: Semantic Scan Context for Large-Scale Place Recognition", IROS 2021',
    "labelled points",
    ssc,
    distance=ssc_distance,
)
