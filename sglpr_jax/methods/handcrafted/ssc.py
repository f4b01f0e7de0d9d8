"""SSC (Li et al., 2021): semantic classes on a polar grid, compared after alignment of the scans."""

import functools
import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int, Int32, UInt8

from sglpr_jax.labels import CATEGORIES
from sglpr_jax.methods.cells import extreme_of_cells, polar
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
FARTHEST_TRANSLATION_M = 5.0
"""Maximum translation along x and along y, in metres. A larger one counts as a failed alignment and is ignored."""
FARTHEST_M = 50.0
USED_CLASSES = (17, 9, 10, 11, 12, 15, 13, 14, 16, 18, 19)
"""Classes that are used (`labels.CATEGORIES`). In a cell with several classes, the last of this list wins."""
LANDMARKS = (13, 14, 16, 18, 19)
"""Building, fence, trunk, pole and traffic sign: the classes whose outlines are aligned."""

FINE = 3
"""A scan is stored in fine cells of a third of a ring and a third of a sector. The alignment moves these cells."""
FINE_SECTORS = FINE * SECTORS
RANK_BITS = 4
"""Bits for the rank of a class: 0 for empty cells, else 1 to 11, its position in `USED_CLASSES`."""
PACKED = 6
"""Cells per number of a descriptor: float32 represents integers of 24 bits exactly."""

ARCTAN = (0.0068117896, -0.033604209, 0.079623658, -0.13233341, 0.19807815, -0.33317368, 0.99999611)
"""Minimax polynomial of arctan(t) / t in t^2, for t from 0 to 1, with a maximum error of 3e-7 radians."""

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
        """Number of fine rings. They reach beyond 50 m by the maximum translation, which can bring outer cells in."""
        return math.ceil((FARTHEST_M + math.sqrt(2) * FARTHEST_TRANSLATION_M) / self.fine_m)

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
    """Return the highest class rank of every fine cell, six to a number, then x (360) and y (360) of the outline.

    Points are in metres, z up; classes are those of `labels.to_classes`. Sector 180 begins at the x axis. The outline
    has one landmark for each sector: the last of its points with a landmark class, or x = y = 0 without such points.
    """
    x, y = points[:, :2].astype(np.float64).T
    radius, angle, _ = polar(points)
    ring = np.floor(radius / grid.fine_m).astype(np.int64)
    sector = np.floor((180 + np.degrees(angle)) * FINE).astype(np.int64)
    inside = (ring < grid.fine_rings) & (sector < FINE_SECTORS)
    rank_of_class = np.zeros(len(CATEGORIES))
    rank_of_class[list(USED_CLASSES)] = 1 + np.arange(len(USED_CLASSES))
    shape = (grid.fine_rings, FINE_SECTORS)
    ranks = extreme_of_cells(np.maximum, shape, (ring[inside], sector[inside]), rank_of_class[classes[inside]])
    landmarks = np.flatnonzero(np.isin(classes, LANDMARKS) & (radius > 0) & (sector < FINE_SECTORS))
    outline = np.zeros((2, SECTORS))
    outline[:, sector[landmarks] // FINE] = x[landmarks], y[landmarks]  # the last landmark of a sector remains
    packed = ranks.reshape(-1, PACKED) @ (1 << RANK_BITS * np.arange(PACKED))
    return np.concatenate([packed, *outline]).astype(np.float32)


def ssc_distance(
    queries: Float32[np.ndarray, "q d"], database: Float32[np.ndarray, "n d"], grid: PolarGrid = PAPER
) -> Float32[np.ndarray, "q n"]:
    """Return 1 - (cells of equal class) / (cells occupied in either scan), after alignment; 1 if no cell is occupied.

    The scan of the database is rotated and moved onto the query (`align`). The published method then sorts its points
    into cells again. Here no points are stored, so the centres of its occupied fine cells are sorted instead.
    """

    def prepare(descriptors):
        fine_ranks, outlines = _unpack(grid, descriptors)
        compared = fine_ranks[:, grid.inner : grid.inner + FINE * grid.rings]
        ranks = compared.reshape(-1, grid.rings, FINE, SECTORS, FINE).max(axis=(2, 4))
        return outlines, ranks.astype(np.int32)

    def prepare_database(descriptors):
        fine_ranks, outlines = _unpack(grid, descriptors)
        centres, ranks = _occupied_cells(grid, fine_ranks)
        return outlines, centres, ranks

    compare = functools.partial(_compare, grid)
    options = {"block": BLOCK, "threads": None, "prepare": prepare, "prepare_database": prepare_database}
    return in_blocks(compare, queries, database, **options)


def _unpack(
    grid: PolarGrid, descriptors: Float32[np.ndarray, "n d"]
) -> tuple[UInt8[np.ndarray, "n rings sectors"], Float32[np.ndarray, "n 2 360"]]:
    """Return the rank of every fine cell, and the outlines (x and y of each sector's landmark) of descriptors."""
    if descriptors.shape[1] != grid.numbers:
        expected = f"descriptors of {grid.numbers} numbers ({grid.rings} rings)"
        raise ValueError(f"expected {expected}, found {descriptors.shape[1]} numbers")
    packed = descriptors[:, : -2 * SECTORS].astype(np.int32)
    outlines = descriptors[:, -2 * SECTORS :].reshape(-1, 2, SECTORS)
    fine_ranks = np.empty((*packed.shape, PACKED), np.uint8)
    for i in range(PACKED):
        fine_ranks[..., i] = packed >> RANK_BITS * i & (1 << RANK_BITS) - 1
    return fine_ranks.reshape(-1, grid.fine_rings, FINE_SECTORS), outlines


def _occupied_cells(
    grid: PolarGrid, fine_ranks: UInt8[np.ndarray, "n rings sectors"]
) -> tuple[Float32[np.ndarray, "n 2 occupied"], Int32[np.ndarray, "n occupied"]]:
    """Return x and y of the centre of every occupied fine cell, and its rank. The lists are padded with rank 0."""
    scan, ring, sector = np.nonzero(fine_ranks)
    counts = np.bincount(scan, minlength=len(fine_ranks))
    slot = np.arange(len(scan)) - np.repeat(np.cumsum(counts) - counts, counts)  # 0, 1, ... in each scan
    width = max(1, math.ceil(counts.max() / WIDTH_STEP)) * WIDTH_STEP
    centres = np.zeros((len(fine_ranks), 2, width), np.float32)
    ranks = np.zeros((len(fine_ranks), width), np.int32)
    radius, angle = (ring + 0.5) * grid.fine_m, np.radians((sector + 0.5) / FINE - 180)
    centres[scan, :, slot] = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    ranks[scan, slot] = fine_ranks[scan, ring, sector]
    return centres, ranks


@functools.partial(jax.jit, static_argnums=0)
def _compare(grid: PolarGrid, queries: tuple[Array, ...], database: tuple[Array, ...]) -> Float[Array, "q n"]:
    """Return the distances of queries (outlines, ranks) to a database (outlines, centres of cells, their ranks)."""

    def distance(query, other):
        (outline, ranks), (other_outline, other_centres, ranks_of_centres) = query, other
        degrees, translation = align(outline, other_outline)
        aligned_centres = rotate(other_centres, degrees) + translation[:, None]
        other_ranks = _highest_ranks(grid, aligned_centres, ranks_of_centres)
        is_occupied = (ranks > 0) | (other_ranks > 0)
        return 1 - jnp.sum(is_occupied & (ranks == other_ranks)) / jnp.maximum(is_occupied.sum(), 1)

    # One pair at a time stays in the cache and runs only the iterations that it needs.
    return jax.lax.map(lambda query: jax.lax.map(lambda other: distance(query, other), database), queries)


def _highest_ranks(grid: PolarGrid, points: Float[Array, "2 n"], ranks: Int[Array, " n"]) -> Int[Array, "rings 360"]:
    """Return the highest rank of the points in every cell, or 0."""
    x, y = points
    ring = jnp.floor((jnp.sqrt(x**2 + y**2) - grid.nearest_m) / (FINE * grid.fine_m)).astype(jnp.int32)
    sector = jnp.floor(180 + jnp.degrees(_angle(x, y))).astype(jnp.int32)
    inside = (ring >= 0) & (ring < grid.rings) & (sector < SECTORS)
    ring_or_dropped = jnp.where(inside, ring, grid.rings)  # an index beyond the array is dropped
    return jnp.zeros((grid.rings, SECTORS), jnp.int32).at[ring_or_dropped, sector].max(ranks, mode="drop")


def _angle(x: Float[Array, " n"], y: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the angle of (x, y) in radians, with an error of 1e-6, in a tenth of the time of `jnp.arctan2`."""
    smaller, larger = jnp.minimum(jnp.abs(x), jnp.abs(y)), jnp.maximum(jnp.abs(x), jnp.abs(y))
    tangent = smaller / jnp.maximum(larger, jnp.finfo(x.dtype).tiny)
    angle_in_octant = tangent * jnp.polyval(jnp.asarray(ARCTAN), tangent**2)
    angle_in_quadrant = jnp.where(jnp.abs(y) > jnp.abs(x), np.pi / 2 - angle_in_octant, angle_in_octant)
    angle_above_x = jnp.where(x < 0, np.pi - angle_in_quadrant, angle_in_quadrant)
    return jnp.where(y < 0, -angle_above_x, angle_above_x)


def align(query: Float[Array, "2 360"], other: Float[Array, "2 360"]) -> tuple[Int[Array, ""], Float[Array, "2"]]:
    """Return the rotation and the translation that move the outline `other` onto `query`.

    Returns:
      The clockwise rotation in degrees, which comes first, and the translation (x, y) in metres. A translation of more
      than 5 m along x or y is replaced by 0.
    """
    degrees = best_shift(jnp.hypot(*query), jnp.hypot(*other))
    rotated = rotate(jnp.roll(other, -degrees, axis=1), degrees)
    translation = best_translation(query, rotated)
    return degrees, jnp.where(jnp.all(jnp.abs(translation) <= FARTHEST_TRANSLATION_M), translation, 0.0)


def best_shift(query_ranges: Float[Array, "360"], other_ranges: Float[Array, "360"]) -> Int[Array, ""]:
    """Return the first s that minimises the sum over the sectors j of |query_ranges[j] - other_ranges[j + s]|."""
    doubled = jnp.concatenate([other_ranges, other_ranges])

    def cost(shift):
        return jnp.abs(query_ranges - jax.lax.dynamic_slice(doubled, (shift,), (SECTORS,))).sum()

    return jnp.argmin(jax.lax.map(cost, jnp.arange(SECTORS)))


def rotate(points: Float[Array, "2 n"], degrees: Int[Array, ""]) -> Float[Array, "2 n"]:
    """Return x and y after a clockwise rotation."""
    cos, sin = jnp.cos(jnp.radians(degrees)), jnp.sin(jnp.radians(degrees))
    x, y = points
    return jnp.stack([x * cos + y * sin, y * cos - x * sin])


def best_translation(query: Float[Array, "2 360"], other: Float[Array, "2 360"]) -> Float[Array, "2"]:
    """Return the translation of `other` onto `query`, by the iterative closest point method in 2-D.

    Each landmark of the query is paired with the nearest landmark of any class in the 20 sectors around its own. The
    step is the sum of the differences of the n pairs within 3 m along x and y, divided by n + 1. Steps are added until
    one is shorter than 10 um, at most 100 times.
    """
    partner_sectors = (np.arange(SECTORS) + PARTNER_SECTORS[:, None]) % SECTORS
    candidates = jnp.moveaxis(other[:, partner_sectors], 1, 0)
    may_pair = _is_landmark(query)[None, :] & _is_landmark(other)[partner_sectors]

    def step(state):
        translation, _, count = state
        offset = _offset_from_nearest(query - translation[:, None], candidates, may_pair)
        is_pair = jnp.all(jnp.abs(offset) < GATE_M, axis=0)
        last_step = jnp.where(is_pair, offset, 0.0).sum(axis=1) / (1 + is_pair.sum())
        return translation + last_step, last_step, count + 1

    def continues(state):
        _, last_step, count = state
        return (count < STEPS) & jnp.any(jnp.abs(last_step) >= SMALLEST_STEP_M)

    translation, _, _ = jax.lax.while_loop(continues, step, (jnp.zeros(2), jnp.full(2, jnp.inf), 0))
    return translation


def _offset_from_nearest(
    points: Float[Array, "2 360"], candidates: Float[Array, "20 2 360"], may_pair: Bool[Array, "20 360"]
) -> Float[Array, "2 360"]:
    """Return x and y of each point relative to its nearest candidate, or infinity if it has no candidate."""

    def keep_nearer(nearest, candidate):
        nearest_square, nearest_offset = nearest
        position, may_pair_with = candidate
        offset = points - position
        square = jnp.where(may_pair_with, jnp.sum(offset**2, axis=0), jnp.inf)
        offset = jnp.where(square < nearest_square, offset, nearest_offset)
        return (jnp.minimum(square, nearest_square), offset), None

    start = jnp.full(SECTORS, jnp.inf), jnp.full((2, SECTORS), jnp.inf)
    # Each step compares one candidate of every sector, which keeps the arrays small.
    (_, offset), _ = jax.lax.scan(keep_nearer, start, (candidates, may_pair))
    return offset


def _is_landmark(outline: Float[Array, "2 360"]) -> Bool[Array, "360"]:
    """Return whether each sector of an outline has a landmark."""
    return jnp.any(outline != 0, axis=0)
