"""Search for the best pose of an image in another one at all rotations and shifts.

The coarse comparison uses half the rotations, and cells and blurs twice as large. It takes a sixth of the time, and
selects the matches of the exact search where descriptors do not tell places apart, for instance among trunks.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from sglpr_jax.grid import DENSITY_RESOLUTION_M
from sglpr_jax.registration.bev_config import VerificationConfig
from sglpr_jax.registration.bev_spectra import DEFAULT, AnyArray, Halves, cell_count, correlations, lower_half

SECOND_M, SECOND_DEG = 3.0, 15.0
"""Minimum distance of the second peak from the best one, in metres or in degrees."""
PRIOR_M, PRIOR_DEG = 2.0, 10.0
"""Maximum distance from an expected pose of a pose near it, in metres and degrees."""
NO_PRIOR = np.full(3, np.nan)
"""Value of an expected pose (x, y, yaw) that is unknown: NaN allows every pose."""
LIKELY = 4
"""Number of rotations, of the coarse comparison, around which the exact search looks. It takes a third of the time of
a search at all rotations."""


@functools.partial(jax.jit, static_argnames="config")
def coarse_correlations(
    query: Complex[AnyArray, "r u g"],
    matches: Complex[AnyArray, "k r g"],
    count: Int[AnyArray, ""] | int | None = None,
    *,
    config: VerificationConfig = DEFAULT,
) -> Float[Array, "k u"]:
    """Highest correlation of a query with each of k matches at any shift, on cells twice as large as in `search`.

    Correlations are listed by rotation, every other one of the first half turn. Those of the opposite direction count
    with them. The arguments are the results of `coarse_query` and, for the spectra of `match_spectra`, of `lower_half`.
    Matches beyond the first `count` get -1.
    """
    rotated, matches = Halves.of(jnp.asarray(query)), jnp.asarray(matches)
    max_shift = cell_count(config.max_shift_m, 2 * DENSITY_RESOLUTION_M * config.coarse)

    def compare(row: Int[Array, ""], highest: Float[Array, "k u"]) -> Float[Array, "k u"]:
        by_rotation = correlations(rotated, matches[row], max_shift).max((0, 2))
        return highest.at[row].set(by_rotation.reshape(2, -1).max(0))

    unknown = jnp.full((len(matches), query.shape[1]), -1.0)
    return jax.lax.fori_loop(0, len(matches) if count is None else count, compare, unknown)


def likely_rotations(coarse: Float[np.ndarray, "k u"]) -> Int[np.ndarray, "k n"]:
    """Numbers of the rotations at which `search` looks, given the result of `coarse_correlations`.

    They are the `LIKELY` best rotations of the coarse comparison and their neighbours among the rotations of `search`.
    """
    best = np.argsort(-coarse, axis=1)[:, :LIKELY, None]
    return ((2 * best + np.arange(-1, 2)) % (2 * coarse.shape[1])).reshape(len(coarse), -1)


@functools.partial(jax.jit, static_argnames="config")
def coarse_query(query: Complex[AnyArray, "s t f"], *, config: VerificationConfig = DEFAULT) -> Complex[Array, "r u g"]:
    """Convert the result of `query_spectra` for `coarse_correlations`: every other rotation, on larger cells."""
    every_other_turn = jnp.asarray(query)[:, ::2].swapaxes(0, 1)  # `lower_half` halves the last two axes
    return lower_half(every_other_turn, config).swapaxes(0, 1)


class CorrelationPeak(NamedTuple):
    """Pose with the highest correlation of a query in the frame of a match, or an array of these poses."""

    x: Float[AnyArray, "*b"]
    y: Float[AnyArray, "*b"]
    """Position of the query in the match's frame, in metres."""
    yaw: Float[AnyArray, "*b"]
    """Rotation of the query, in radians, counter-clockwise, from 0 to 2 pi."""
    correlation: Float[AnyArray, "*b"]
    """Correlation at the pose: 1 for equal images, about 0 for unrelated ones."""
    second: Float[AnyArray, "*b"]
    """Highest correlation at poses more than `SECOND_M` or `SECOND_DEG` away."""

    def at(self, rows: int | slice) -> "CorrelationPeak":
        """Select one peak by its row, or several by a slice."""
        return CorrelationPeak(*(field[rows] for field in self))


NO_PEAKS = CorrelationPeak(*[np.zeros(0, np.float32)] * len(CorrelationPeak._fields))


@functools.partial(jax.jit, static_argnames="config")
def search(
    query: Complex[AnyArray, "s t f"],
    matches: Complex[AnyArray, "k s f"],
    count: Int[AnyArray, ""] | int | None = None,
    rotations: Int[AnyArray, "k n"] | None = None,
    *,
    config: VerificationConfig = DEFAULT,
) -> CorrelationPeak:
    """Return the best pose of a query in the frame of each of k matches.

    Arguments:
      query: Result of `query_spectra`.
      matches: Result of `match_spectra`.
      count: Number of matches that are searched, the first ones, by one compiled program for every count. The peaks of
        the others are 0. None: all.
      rotations: Result of `likely_rotations`. The correlation at other rotations counts as 0. None: all rotations.
    """
    rotated, matches, max_shift = Halves.of(jnp.asarray(query)), jnp.asarray(matches), _max_shift_cells(config)

    def volume_of(row: Int[Array, ""]) -> Float[Array, "d t d"]:
        if rotations is None:
            return correlations(rotated, matches[row], max_shift)
        likely = jnp.asarray(rotations)[row]
        values = correlations(rotated.at(likely), matches[row], max_shift)
        everywhere = jnp.zeros((values.shape[0], config.turns, values.shape[2]))
        return everywhere.at[:, jnp.concatenate([likely, likely + config.turns // 2])].set(values)

    def search_row(row: Int[Array, ""], peaks: CorrelationPeak) -> CorrelationPeak:
        peak = _highest_peak(volume_of(row), jnp.asarray(NO_PRIOR, jnp.float32), config)
        return jax.tree.map(lambda field, value: field.at[row].set(value), peaks, peak)

    zeros = CorrelationPeak(*[jnp.zeros(len(matches))] * len(CorrelationPeak._fields))
    return jax.lax.fori_loop(0, len(matches) if count is None else count, search_row, zeros)


@functools.partial(jax.jit, static_argnames="config")
def search_near(
    query: Complex[AnyArray, "s t f"],
    match: Complex[AnyArray, "s f"],
    prior: Float[AnyArray, " 3"],
    *,
    config: VerificationConfig = DEFAULT,
) -> CorrelationPeak:
    """Return two peaks: the best pose anywhere, and the best pose near an expected one.

    Arguments:
      query: Result of `query_spectra`.
      match: Row of `match_spectra`.
      prior: Expected x, y (metres) and yaw (radians), or `NO_PRIOR`.
    """
    volume = correlations(Halves.of(jnp.asarray(query)), jnp.asarray(match), _max_shift_cells(config))
    priors = jnp.stack([jnp.asarray(NO_PRIOR, jnp.float32), jnp.asarray(prior, jnp.float32)])
    return jax.lax.map(lambda prior: _highest_peak(volume, prior, config), priors)


def _max_shift_cells(config: VerificationConfig) -> int:
    """Maximum shift along x and along y, in merged cells (`config.coarse` cells per side)."""
    return cell_count(config.max_shift_m, DENSITY_RESOLUTION_M * config.coarse)


def _highest_peak(
    volume: Float[Array, "d t r"], prior: Float[Array, " 3"], config: VerificationConfig
) -> CorrelationPeak:
    """Highest peak near the expected x, y (metres) and yaw (radians) or, with `NO_PRIOR`, anywhere.

    `volume` is the correlation by row shift, rotation and column shift, the result of `correlations`.
    """
    max_shift, turn_rad = len(volume) // 2, np.float32(2 * np.pi / config.turns)
    cell_m = DENSITY_RESOLUTION_M * config.coarse
    x, y, yaw = prior
    has_prior = ~jnp.isnan(x)
    expected = max_shift - y / cell_m, yaw / turn_rad, max_shift + x / cell_m  # rows run down, y runs up
    near_prior = _near(volume.shape, expected, PRIOR_M / cell_m, PRIOR_DEG)
    highest = volume.max(0)  # maximum over row shifts, the slowest axis, which is fast
    allowed = jnp.where(has_prior, jnp.where(near_prior, volume, -1.0).max(0), highest)
    turn, column = jnp.unravel_index(jnp.argmax(allowed), allowed.shape)
    by_row = jnp.where(near_prior[:, turn, column] | ~has_prior, volume[:, turn, column], -1.0)
    peak = jnp.argmax(by_row), turn, column
    second = _second_peak(volume, highest, peak, cell_m, config)
    row, turn, column = (index + offset for index, offset in zip(peak, _subcell_offsets(volume, peak), strict=True))
    x, y, yaw = (column - max_shift) * cell_m, (max_shift - row) * cell_m, jnp.mod(turn * turn_rad, 2 * np.pi)
    return CorrelationPeak(x, y, yaw, volume[peak], second)


def _second_peak(
    volume: Float[Array, "d t r"],
    highest: Float[Array, "t r"],
    peak: tuple[Int[Array, ""], ...],
    cell_m: float,
    config: VerificationConfig,
) -> Float[Array, ""]:
    """Highest correlation more than `SECOND_M` or `SECOND_DEG` away from a peak, given by its index in `volume`.

    The axes of `volume` are row shift, rotation and column shift, with shifts in steps of `cell_m` metres. `highest` is
    its maximum over row shifts.
    """
    row, turn, column = peak
    near_turns = int(SECOND_DEG * config.turns / 360 + 1e-6)
    turns = jnp.mod(turn + np.arange(-near_turns, near_turns + 1), config.turns)
    block = volume[:, turns]  # only at these rotations, a shift can be near the peak
    near = _near(block.shape, (row, near_turns, column), SECOND_M / cell_m, 360.0)
    other_turns = jnp.ones(config.turns, bool).at[turns].set(False)
    return jnp.maximum(jnp.max(jnp.where(other_turns[:, None], highest, 0.0)), jnp.max(jnp.where(~near, block, 0.0)))


def _subcell_offsets(volume: Float[Array, "d t r"], peak: tuple[Int[Array, ""], ...]) -> list[Float[Array, ""]]:
    """Offset of the maximum from the index of a peak along each axis, from -0.5 to 0.5, by a parabola.

    The axes are row shift, rotation and column shift. Rotations wrap around. At the ends of the other axes, the
    outermost value is repeated.
    """
    offsets = []
    for axis, index in enumerate(peak):
        size = volume.shape[axis]
        before, after = index - 1, index + 1
        if axis != 1:
            before, after = jnp.maximum(before, 0), jnp.minimum(after, size - 1)
        low, middle, high = (
            volume[(*peak[:axis], neighbour, *peak[axis + 1 :])] for neighbour in (before % size, index, after % size)
        )
        curvature = low - 2 * middle + high
        offset = (low - high) / (2 * jnp.where(curvature < 0, curvature, -1e9))  # 0 if the peak is flat
        offsets.append(jnp.clip(offset, -0.5, 0.5))
    return offsets


def _near(
    shape: tuple[int, ...], pose: Sequence[Float[Array, ""] | Int[Array, ""] | int], max_cells: float, max_deg: float
) -> Bool[Array, "d t r"]:
    """Whether each element of a volume of this shape is within `max_cells` and `max_deg` of a pose.

    The axes, and the indices of `pose`, are row shift, rotation (over the whole circle) and column shift.
    """
    rows, turns, columns = (jnp.abs(jnp.arange(n) - index) for n, index in zip(shape, pose, strict=True))
    turns = jnp.mod(turns, shape[1])
    near_turn = jnp.minimum(turns, shape[1] - turns) * (360 / shape[1]) <= max_deg
    near_row, near_column = rows <= max_cells + 1e-6, columns <= max_cells + 1e-6
    return near_row[:, None, None] & near_turn[None, :, None] & near_column[None, None, :]
