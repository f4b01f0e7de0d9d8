"""SSC (Li et al., 2021): semantic classes on a polar grid, compared after one scan is laid onto the other."""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int, Int32, UInt8

from sglpr_jax.labels import CATEGORIES
from sglpr_jax.methods.method import HandcraftedMethod
from sglpr_jax.methods.outline_alignment import FARTHEST_MOVE_M, SECTORS, align, turn
from sglpr_jax.methods.pairwise import in_blocks

FARTHEST_M = 50.0
STRONGER = (17, 9, 10, 11, 12, 15, 13, 14, 16, 18, 19)
"""The classes that count (`labels.CATEGORIES`), each before those that take a cell from it. The others are left out."""
LANDMARKS = (13, 14, 16, 18, 19)
"""Building, fence, trunk, pole and traffic sign: the classes whose outlines are laid on each other."""

FINER = 3
"""A scan is kept in cells of a third of a ring and of a sector: those are what is moved."""
FINE_SECTORS = FINER * SECTORS
RANK_BITS = 4
PACKED = 6
"""Cells in one number of a descriptor: float32 holds whole numbers of 24 bits exactly."""

ARCTAN = (0.0068117896, -0.033604209, 0.079623658, -0.13233341, 0.19807815, -0.33317368, 0.99999611)
"""Of arctan(t) / t in t^2, from 0 to 1: the polynomial whose greatest error is least, 3e-7 radians."""

BLOCK = 64
WIDTH_STEP = 8192
"""Lists of occupied cells are filled up to a multiple of it, so that few lengths are compiled."""


@dataclass(frozen=True)
class PolarGrid:
    """The rings that two scans are compared in: from `nearest_m` to 50 m."""

    rings: int
    nearest_m: float

    @property
    def fine_m(self) -> float:
        """The width of the rings that a scan is kept in; they begin at the sensor."""
        return (FARTHEST_M - self.nearest_m) / self.rings / FINER

    @property
    def inner(self) -> int:
        """How many fine rings lie before `nearest_m`: a move may bring them in."""
        return round(self.nearest_m / self.fine_m)

    @property
    def fine_rings(self) -> int:
        """As far out as a move may bring cells in from."""
        return math.ceil((FARTHEST_M + math.sqrt(2) * FARTHEST_MOVE_M) / self.fine_m)

    @property
    def numbers(self) -> int:
        """Of a descriptor."""
        return self.fine_rings * FINE_SECTORS // PACKED + 2 * SECTORS


PAPER = PolarGrid(50, 0.0)
"""Of the version that the authors name for the paper."""
NEWEST = PolarGrid(24, 5.0)
"""Of their last version."""


def ssc(
    points: Float32[np.ndarray, "n 3"], classes: Int32[np.ndarray, " n"], grid: PolarGrid = PAPER
) -> Float32[np.ndarray, " d"]:
    """Return the strongest class of every fine cell, six to a number, then x (360) and y (360) of the landmarks.

    Points are metres, x forward, y left, z up; classes are those of `labels.to_classes`. Sectors are degrees from the
    back. A sector's landmark is the last in the order of the points, at any range but 0; x = y = 0: it has none.
    """
    x, y = points[:, :2].astype(np.float64).T
    radius, degrees = np.hypot(x, y), 180 + np.degrees(np.arctan2(y, x))
    ring, sector = np.floor(radius / grid.fine_m).astype(np.int64), np.floor(degrees * FINER).astype(np.int64)
    inside = (ring < grid.fine_rings) & (sector < FINE_SECTORS)
    cells = np.zeros(grid.fine_rings * FINE_SECTORS, np.int64)
    np.maximum.at(cells, (ring * FINE_SECTORS + sector)[inside], _ranks()[classes[inside]])
    landmarks = np.flatnonzero(np.isin(classes, LANDMARKS) & (radius > 0) & (sector < FINE_SECTORS))
    outline = np.zeros((2, SECTORS))
    outline[:, sector[landmarks] // FINER] = x[landmarks], y[landmarks]  # of equal sectors the last one stays
    packed = cells.reshape(-1, PACKED) @ (1 << RANK_BITS * np.arange(PACKED))
    return np.concatenate([packed, *outline]).astype(np.float32)


@functools.cache
def _ranks() -> Int[np.ndarray, "20"]:
    """Return by class its place in `STRONGER`, from 1; 0: left out."""
    ranks = np.zeros(len(CATEGORIES), np.int64)
    ranks[list(STRONGER)] = 1 + np.arange(len(STRONGER))
    return ranks


class _Still(NamedTuple):
    """What is compared of the n scans that stay as they are."""

    outlines: Float32[np.ndarray, "n 2 360"]
    cells: Int32[np.ndarray, "n rings 360"]


class _Moved(NamedTuple):
    """What is compared of the n scans that are laid onto the others: the centres of their fine cells."""

    outlines: Float32[np.ndarray, "n 2 360"]
    centres: Float32[np.ndarray, "n 2 occupied"]
    ranks: Int32[np.ndarray, "n occupied"]


def ssc_distance(
    queries: Float32[np.ndarray, "q d"], database: Float32[np.ndarray, "n d"], grid: PolarGrid = PAPER
) -> Float32[np.ndarray, "q n"]:
    """Return 1 - (cells of equal class) / (cells occupied in either), after alignment; 1 where no cell is occupied.

    The scan of the database is turned and moved onto the query (`outline_alignment`). The published method then divides
    its points into cells anew; here, where no points are kept, the centres of its occupied fine cells.
    """
    compare = functools.partial(_compare, grid)
    ways = {"prepare": functools.partial(_still, grid), "prepare_database": functools.partial(_moved, grid)}
    return in_blocks(compare, queries, database, block=BLOCK, threads=None, **ways)


def _still(grid: PolarGrid, rows: Float32[np.ndarray, "n d"]) -> _Still:
    fine, outlines = _unpacked(grid, rows)
    compared = fine[:, grid.inner : grid.inner + FINER * grid.rings]
    cells = compared.reshape(-1, grid.rings, FINER, SECTORS, FINER).max(axis=(2, 4))
    return _Still(outlines, cells.astype(np.int32))


def _moved(grid: PolarGrid, rows: Float32[np.ndarray, "n d"]) -> _Moved:
    fine, outlines = _unpacked(grid, rows)
    return _Moved(outlines, *_occupied(grid, fine))


def _unpacked(
    grid: PolarGrid, rows: Float32[np.ndarray, "n d"]
) -> tuple[UInt8[np.ndarray, "n rings sectors"], Float32[np.ndarray, "n 2 360"]]:
    """Return the rank of every fine cell, and the outlines."""
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
    """Return x and y of the middle of every occupied cell, and its rank; filled up with ranks of 0."""
    scan, ring, sector = np.nonzero(fine)
    counts = np.bincount(scan, minlength=len(fine))
    place = np.arange(len(scan)) - np.repeat(np.cumsum(counts) - counts, counts)
    width = max(1, math.ceil(counts.max() / WIDTH_STEP)) * WIDTH_STEP
    centres, ranks = np.zeros((len(fine), 2, width), np.float32), np.zeros((len(fine), width), np.int32)
    radius, angle = (ring + 0.5) * grid.fine_m, np.radians((sector + 0.5) / FINER - 180)
    centres[scan, :, place] = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    ranks[scan, place] = fine[scan, ring, sector]
    return centres, ranks


@functools.partial(jax.jit, static_argnums=0)
def _compare(grid: PolarGrid, queries: _Still, database: _Moved) -> Float[Array, "q n"]:
    """Return the distances of all pairs, one at a time: it stays in the cache, and takes the steps that it needs."""

    def distance(query, other):
        shift, move = align(query.outlines, other.outlines)
        moved = turn(other.centres, shift) + move[:, None]
        return 1 - similarity(query.cells, _cells_of(grid, moved, other.ranks))

    return jax.lax.map(lambda query: jax.lax.map(lambda other: distance(query, other), database), queries)


def _cells_of(grid: PolarGrid, points: Float[Array, "2 n"], ranks: Int[Array, " n"]) -> Int[Array, "rings 360"]:
    """Return the greatest rank in every cell."""
    x, y = points
    ring = jnp.floor((jnp.sqrt(x**2 + y**2) - grid.nearest_m) / (FINER * grid.fine_m)).astype(jnp.int32)
    sector = jnp.floor(180 + jnp.degrees(_angle(x, y))).astype(jnp.int32)
    inside = (ring >= 0) & (ring < grid.rings) & (sector < SECTORS)
    cells = jnp.zeros((grid.rings, SECTORS), jnp.int32)
    return cells.at[jnp.where(inside, ring, grid.rings), sector].max(ranks, mode="drop")


def _angle(x: Float[Array, " n"], y: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the angle of (x, y) in radians, to 1e-6: on a CPU in a tenth of `jnp.arctan2`'s time."""
    low, high = jnp.minimum(jnp.abs(x), jnp.abs(y)), jnp.maximum(jnp.abs(x), jnp.abs(y))
    octant = low / jnp.maximum(high, jnp.finfo(x.dtype).tiny)
    quadrant = octant * jnp.polyval(jnp.asarray(ARCTAN), octant**2)
    half = jnp.where(jnp.abs(y) > jnp.abs(x), np.pi / 2 - quadrant, quadrant)
    turned = jnp.where(x < 0, np.pi - half, half)
    return jnp.where(y < 0, -turned, turned)


def similarity(a: Int[Array, "rings 360"], b: Int[Array, "rings 360"]) -> Float[Array, ""]:
    """Return the share of equal cells among those occupied in either; 0 where there are none."""
    either = (a > 0) | (b > 0)
    return jnp.sum(either & (a == b)) / jnp.maximum(either.sum(), 1)


def ssc_24(points: Float32[np.ndarray, "n 3"], classes: Int32[np.ndarray, " n"]) -> Float32[np.ndarray, " d"]:
    """Return `ssc` with the grid `NEWEST`."""
    return ssc(points, classes, NEWEST)


def ssc_24_distance(
    queries: Float32[np.ndarray, "q d"], database: Float32[np.ndarray, "n d"]
) -> Float32[np.ndarray, "q n"]:
    """Return `ssc_distance` with the grid `NEWEST`."""
    return ssc_distance(queries, database, NEWEST)


SSC = HandcraftedMethod(
    "ssc",
    'Li et al., "SSC: Semantic Scan Context for Large-Scale Place Recognition", IROS 2021',
    "labelled points",
    ssc,
    distance=ssc_distance,
)
SSC_24 = HandcraftedMethod(
    "ssc-24",
    "SSC with the 24 rings from 5 m of its authors' last version",
    "labelled points",
    ssc_24,
    distance=ssc_24_distance,
)
