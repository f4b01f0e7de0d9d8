"""SSC (Li et al., 2021): semantic classes on a polar grid, compared after alignment of the scans."""

import functools
import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int, Int32, UInt8

from sglpr_jax.labels import CATEGORIES
from sglpr_jax.methods.cells import extreme, polar
from sglpr_jax.methods.pairwise import in_blocks

SECTORS = 360
PARTNER_SECTORS = np.arange(-10, 10)
"""Sectors in which the partner of a landmark is searched, relative to its own sector."""
GATE_M = 3.0
"""Maximum distance of partners along x and along y, in metres."""
STEPS = 100
"""Maximum number of iterations of the iterative closest point method."""
SMALLEST_STEP_M = 1e-5
"""The iteration stops when a step is shorter than this along x and along y, in metres."""
FARTHEST_MOVE_M = 5.0
"""Maximum translation along x and along y, in metres. Larger translations count as failures."""
FARTHEST_M = 50.0
USED_CLASSES = (17, 9, 10, 11, 12, 15, 13, 14, 16, 18, 19)
"""The classes that are used (`labels.CATEGORIES`), in rising order of priority in a cell. Other classes are ignored."""
LANDMARKS = (13, 14, 16, 18, 19)
"""Building, fence, trunk, pole and traffic sign: the classes whose outlines are aligned."""

FINE = 3
"""A scan is stored in fine cells of a third of a ring and a third of a sector. The alignment moves these cells."""
FINE_SECTORS = FINE * SECTORS
RANK_BITS = 4
PACKED = 6
"""Cells per number of a descriptor: float32 represents integers of 24 bits exactly."""

ARCTAN = (0.0068117896, -0.033604209, 0.079623658, -0.13233341, 0.19807815, -0.33317368, 0.99999611)
"""Coefficients of arctan(t) / t in t^2, for t from 0 to 1: the minimax polynomial, with a maximum error of 3e-7
radians."""

BLOCK = 64
WIDTH_STEP = 8192
"""Lists of occupied cells are padded to a multiple of this length, so that few lengths are compiled."""


@dataclass(frozen=True)
class PolarGrid:
    """Rings in which two scans are compared, from `nearest_m` to 50 m."""

    rings: int
    nearest_m: float

    @property
    def fine_m(self) -> float:
        """Width of the fine rings, in metres. They begin at the sensor."""
        return (FARTHEST_M - self.nearest_m) / self.rings / FINE

    @property
    def inner(self) -> int:
        """Number of fine rings within `nearest_m`. A translation may move them beyond it."""
        return round(self.nearest_m / self.fine_m)

    @property
    def fine_rings(self) -> int:
        """Number of fine rings. They reach as far out as a translation may bring cells in from."""
        return math.ceil((FARTHEST_M + math.sqrt(2) * FARTHEST_MOVE_M) / self.fine_m)

    @property
    def numbers(self) -> int:
        """Length of a descriptor."""
        return self.fine_rings * FINE_SECTORS // PACKED + 2 * SECTORS


PAPER = PolarGrid(50, 0.0)
"""Grid of the version that the authors name for the paper."""
NEWEST = PolarGrid(24, 5.0)
"""Grid of the authors' last version."""


def ssc(
    points: Float32[np.ndarray, "n 3"], classes: Int32[np.ndarray, " n"], grid: PolarGrid = PAPER
) -> Float32[np.ndarray, " d"]:
    """Return the rank of the strongest class of every fine cell, six to a number, and x (360) and y (360) of landmarks.

    Points are in metres, z up; classes are those of `labels.to_classes`. Sectors are degrees from the back. The
    landmark of a sector is its last landmark point, at any nonzero range, or x = y = 0.
    """
    x, y = points[:, :2].astype(np.float64).T
    radius, angle, _ = polar(points)
    ring = np.floor(radius / grid.fine_m).astype(np.int64)
    sector = np.floor((180 + np.degrees(angle)) * FINE).astype(np.int64)
    inside = (ring < grid.fine_rings) & (sector < FINE_SECTORS)
    ranks = np.zeros(len(CATEGORIES))
    ranks[list(USED_CLASSES)] = 1 + np.arange(len(USED_CLASSES))
    shape = (grid.fine_rings, FINE_SECTORS)
    cells = extreme(np.maximum, shape, (ring[inside], sector[inside]), ranks[classes[inside]])
    landmarks = np.flatnonzero(np.isin(classes, LANDMARKS) & (radius > 0) & (sector < FINE_SECTORS))
    outline = np.zeros((2, SECTORS))
    outline[:, sector[landmarks] // FINE] = x[landmarks], y[landmarks]  # in each sector, the last landmark wins
    packed = cells.reshape(-1, PACKED) @ (1 << RANK_BITS * np.arange(PACKED))
    return np.concatenate([packed, *outline]).astype(np.float32)


def ssc_distance(
    queries: Float32[np.ndarray, "q d"], database: Float32[np.ndarray, "n d"], grid: PolarGrid = PAPER
) -> Float32[np.ndarray, "q n"]:
    """Return 1 - (cells of equal class) / (cells occupied in either scan), after alignment; 1 if no cell is occupied.

    The scan of the database is rotated and moved onto the query (`align`). The published method then sorts its points
    into cells again. Here no points are stored, so the centres of its occupied fine cells are sorted instead.
    """

    def prepare(rows):
        fine, outlines = _unpack(grid, rows)
        compared = fine[:, grid.inner : grid.inner + FINE * grid.rings]
        cells = compared.reshape(-1, grid.rings, FINE, SECTORS, FINE).max(axis=(2, 4))
        return outlines, cells.astype(np.int32)

    def prepare_database(rows):
        fine, outlines = _unpack(grid, rows)
        return outlines, *_occupied(grid, fine)

    compare = functools.partial(_compare, grid)
    options = {"block": BLOCK, "threads": None, "prepare": prepare, "prepare_database": prepare_database}
    return in_blocks(compare, queries, database, **options)


def _unpack(
    grid: PolarGrid, rows: Float32[np.ndarray, "n d"]
) -> tuple[UInt8[np.ndarray, "n rings sectors"], Float32[np.ndarray, "n 2 360"]]:
    """Return the rank of every fine cell, and the outlines (x and y of each sector's landmark)."""
    if rows.shape[1] != grid.numbers:
        raise ValueError(f"expected rows of {grid.numbers} numbers ({grid.rings} rings), found {rows.shape[1]}")
    packed, outlines = rows[:, : -2 * SECTORS].astype(np.int32), rows[:, -2 * SECTORS :].reshape(-1, 2, SECTORS)
    fine = np.empty((*packed.shape, PACKED), np.uint8)
    for i in range(PACKED):
        fine[..., i] = packed >> RANK_BITS * i & (1 << RANK_BITS) - 1
    return fine.reshape(-1, grid.fine_rings, FINE_SECTORS), outlines


def _occupied(
    grid: PolarGrid, fine: UInt8[np.ndarray, "n rings sectors"]
) -> tuple[Float32[np.ndarray, "n 2 occupied"], Int32[np.ndarray, "n occupied"]]:
    """Return x and y of the centre of every occupied cell, and its rank. The lists are padded with rank 0."""
    scan, ring, sector = np.nonzero(fine)
    counts = np.bincount(scan, minlength=len(fine))
    place = np.arange(len(scan)) - np.repeat(np.cumsum(counts) - counts, counts)
    width = max(1, math.ceil(counts.max() / WIDTH_STEP)) * WIDTH_STEP
    centres, ranks = np.zeros((len(fine), 2, width), np.float32), np.zeros((len(fine), width), np.int32)
    radius, angle = (ring + 0.5) * grid.fine_m, np.radians((sector + 0.5) / FINE - 180)
    centres[scan, :, place] = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    ranks[scan, place] = fine[scan, ring, sector]
    return centres, ranks


@functools.partial(jax.jit, static_argnums=0)
def _compare(grid: PolarGrid, queries: tuple[Array, ...], database: tuple[Array, ...]) -> Float[Array, "q n"]:
    """Return the distances of outlines and cells to outlines, centres and ranks. One pair at a time stays in the cache
    and runs only the iterations that it needs."""

    def distance(query, other):
        (outline, cells), (other_outline, centres, ranks) = query, other
        shift, move = align(outline, other_outline)
        other_cells = _cells_of(grid, rotate(centres, shift) + move[:, None], ranks)
        either = (cells > 0) | (other_cells > 0)
        return 1 - jnp.sum(either & (cells == other_cells)) / jnp.maximum(either.sum(), 1)

    return jax.lax.map(lambda query: jax.lax.map(lambda other: distance(query, other), database), queries)


def _cells_of(grid: PolarGrid, points: Float[Array, "2 n"], ranks: Int[Array, " n"]) -> Int[Array, "rings 360"]:
    """Return the highest rank in every cell."""
    x, y = points
    ring = jnp.floor((jnp.sqrt(x**2 + y**2) - grid.nearest_m) / (FINE * grid.fine_m)).astype(jnp.int32)
    sector = jnp.floor(180 + jnp.degrees(_angle(x, y))).astype(jnp.int32)
    inside = (ring >= 0) & (ring < grid.rings) & (sector < SECTORS)
    cells = jnp.zeros((grid.rings, SECTORS), jnp.int32)
    return cells.at[jnp.where(inside, ring, grid.rings), sector].max(ranks, mode="drop")


def _angle(x: Float[Array, " n"], y: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the angle of (x, y) in radians, with an error of 1e-6, in a tenth of the time of `jnp.arctan2`."""
    low, high = jnp.minimum(jnp.abs(x), jnp.abs(y)), jnp.maximum(jnp.abs(x), jnp.abs(y))
    octant = low / jnp.maximum(high, jnp.finfo(x.dtype).tiny)
    quadrant = octant * jnp.polyval(jnp.asarray(ARCTAN), octant**2)
    half = jnp.where(jnp.abs(y) > jnp.abs(x), np.pi / 2 - quadrant, quadrant)
    whole = jnp.where(x < 0, np.pi - half, half)
    return jnp.where(y < 0, -whole, whole)


def align(query: Float[Array, "2 360"], other: Float[Array, "2 360"]) -> tuple[Int[Array, ""], Float[Array, "2"]]:
    """Return the clockwise rotation of the outline `other`, in degrees, and then its translation (x, y), in metres. A
    translation of more than 5 m along x or y is replaced by 0."""
    shift = best_shift(jnp.hypot(*query), jnp.hypot(*other))
    move = best_move(query, rotate(jnp.roll(other, -shift, axis=1), shift))
    return shift, jnp.where(jnp.all(jnp.abs(move) <= FARTHEST_MOVE_M), move, 0.0)


def best_shift(query: Float[Array, "360"], other: Float[Array, "360"]) -> Int[Array, ""]:
    """Return the first s that minimises the sum over j of |query[j] - other[j + s]|."""
    doubled = jnp.concatenate([other, other])
    costs = jax.lax.map(
        lambda s: jnp.abs(query - jax.lax.dynamic_slice(doubled, (s,), (SECTORS,))).sum(), jnp.arange(SECTORS)
    )
    return jnp.argmin(costs)


def rotate(points: Float[Array, "2 n"], degrees: Int[Array, ""]) -> Float[Array, "2 n"]:
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
    partners = (np.arange(SECTORS) + PARTNER_SECTORS[:, None]) % SECTORS
    candidates = jnp.moveaxis(other[:, partners], 1, 0)
    may_pair = _is_landmark(query)[None, :] & _is_landmark(other)[partners]

    def step(state):
        move, _, count = state
        offset = _to_nearest(query - move[:, None], candidates, may_pair)
        near = jnp.all(jnp.abs(offset) < GATE_M, axis=0)
        last_step = jnp.where(near, offset, 0.0).sum(axis=1) / (1 + near.sum())
        return move + last_step, last_step, count + 1

    def has_moved(state):
        _, last_step, count = state
        return (count < STEPS) & jnp.any(jnp.abs(last_step) >= SMALLEST_STEP_M)

    return jax.lax.while_loop(has_moved, step, (jnp.zeros(2), jnp.full(2, jnp.inf), 0))[0]


def _to_nearest(
    points: Float[Array, "2 360"], candidates: Float[Array, "20 2 360"], may_pair: Bool[Array, "20 360"]
) -> Float[Array, "2 360"]:
    """Return the offset in x and y from each point's nearest candidate to the point; infinity without a candidate."""

    def nearer(best, candidate):
        best_square, best_offset = best
        offset = points - candidate[0]
        square = jnp.where(candidate[1], jnp.sum(offset**2, axis=0), jnp.inf)
        return (jnp.minimum(square, best_square), jnp.where(square < best_square, offset, best_offset)), None

    start = jnp.full(SECTORS, jnp.inf), jnp.full((2, SECTORS), jnp.inf)
    # One candidate for all sectors at a time keeps the arrays small and the loop simple.
    return jax.lax.scan(nearer, start, (candidates, may_pair))[0][1]


def _is_landmark(outline: Float[Array, "2 360"]) -> Bool[Array, "360"]:
    return jnp.any(outline != 0, axis=0)
