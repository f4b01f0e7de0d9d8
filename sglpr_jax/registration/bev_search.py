"""Search for the best pose of an image in another one, exactly or, at little cost, coarsely.

The coarse comparison has half as many rotations, cells and blurs twice as large, and takes a sixth of the time. It
replaces the descriptors where these do not tell places apart, for instance among trunks.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from sglpr_jax.grid import DENSITY_RESOLUTION_M
from sglpr_jax.registration.bev_spectra import DEFAULT, AnyArray, cell_count, correlations, lower_half, quarters
from sglpr_jax.registration.config import VerificationConfig

SECOND_M, SECOND_DEG = 3.0, 15.0
"""Minimum distance of the second peak from the best one, in metres or in degrees."""
PRIOR_M, PRIOR_DEG = 2.0, 10.0
"""Maximum distance of a pose from the expected pose, if there is one, in metres and degrees."""


@functools.partial(jax.jit, static_argnames="config")
def coarse_correlations(
    query: Complex[AnyArray, "2 s t f"],
    matches: Complex[AnyArray, "k s f"],
    count: Int[AnyArray, ""] | int | None = None,
    *,
    config: VerificationConfig = DEFAULT,
) -> Float[Array, " k"]:
    """Highest correlation of a query with each match at any pose, by the coarse comparison.

    The arguments are those of `search`. Matches beyond `count` get -1.
    """
    rotated = quarters(lower_half(jnp.asarray(query)[:, :, ::2].swapaxes(1, 2), config).swapaxes(1, 2))
    matches = lower_half(jnp.asarray(matches), config)
    reach = cell_count(config.max_shift_m, 2 * DENSITY_RESOLUTION_M * config.coarse)

    def compare(k: Int[Array, ""], highest: Float[Array, " k"]) -> Float[Array, " k"]:
        return highest.at[k].set(correlations(rotated, matches[k], reach).max((0, 2)).max())

    return jax.lax.fori_loop(0, len(matches) if count is None else count, compare, jnp.full(len(matches), -1.0))


class CorrelationPeak(NamedTuple):
    """The best pose of a query in the frame of a match, to a fraction of a merged cell."""

    x: Float[AnyArray, "*b"]
    y: Float[AnyArray, "*b"]
    """Position of the query in the match's frame, in metres."""
    yaw: Float[AnyArray, "*b"]
    """Rotation of the query, in radians, counter-clockwise, from 0 to 2 pi."""
    correlation: Float[AnyArray, "*b"]
    """Correlation at the pose: 1 for equal images, about 0 for unrelated ones."""
    second: Float[AnyArray, "*b"]
    """Highest correlation at any other pose, at least `SECOND_M` or `SECOND_DEG` away."""

    def at(self, rows: int | slice) -> "CorrelationPeak":
        """One of the peaks, or some of them."""
        return CorrelationPeak(*(values[rows] for values in self))


NO_PEAKS = CorrelationPeak(*[np.zeros(0, np.float32)] * len(CorrelationPeak._fields))


@functools.partial(jax.jit, static_argnames="config")
def search(
    query: Complex[AnyArray, "2 s t f"],
    matches: Complex[AnyArray, "k s f"],
    count: Int[AnyArray, ""] | int | None = None,
    *,
    config: VerificationConfig = DEFAULT,
) -> CorrelationPeak:
    """Return the best pose of a query in the frame of each of k matches.

    The arguments are results of `query_spectra` and `match_spectra`. With `count`, only the first matches are searched,
    by the same compiled program for every count.
    """
    rotated, matches, reach = quarters(jnp.asarray(query)), jnp.asarray(matches), _reach(config)

    def search_one(k: Int[Array, ""], peaks: CorrelationPeak) -> CorrelationPeak:
        peak = _peak(correlations(rotated, matches[k], reach), jnp.full(3, jnp.nan), config)
        return jax.tree.map(lambda values, value: values.at[k].set(value), peaks, peak)

    none = CorrelationPeak(*[jnp.zeros(len(matches))] * len(CorrelationPeak._fields))
    return jax.lax.fori_loop(0, len(matches) if count is None else count, search_one, none)


@functools.partial(jax.jit, static_argnames="config")
def search_near(
    query: Complex[AnyArray, "2 s t f"],
    match: Complex[AnyArray, "s f"],
    prior: Float[AnyArray, " 3"],
    *,
    config: VerificationConfig = DEFAULT,
) -> CorrelationPeak:
    """Return two peaks: the best pose anywhere, and the best pose near an expected one.

    Arguments:
      query: Result of `query_spectra`.
      match: Row of `match_spectra`.
      prior: Expected x, y (metres) and yaw (radians). NaN if there is no expected pose.
      config: Settings of the comparison.
    """
    volume = correlations(quarters(jnp.asarray(query)), jnp.asarray(match), _reach(config))
    priors = jnp.stack([jnp.full(3, jnp.nan), jnp.asarray(prior, jnp.float32)])
    return jax.lax.map(lambda prior: _peak(volume, prior, config), priors)


def _reach(config: VerificationConfig) -> int:
    """Maximum shift, in merged cells."""
    return cell_count(config.max_shift_m, DENSITY_RESOLUTION_M * config.coarse)


def _peak(volume: Float[Array, "d t r"], prior: Float[Array, " 3"], config: VerificationConfig) -> CorrelationPeak:
    """Highest peak of the correlations of all shifts and rotations, near the expected pose. NaN allows all poses."""
    reach, step = len(volume) // 2, np.float32(2 * np.pi / config.turns)
    cell_m = DENSITY_RESOLUTION_M * config.coarse
    x, y, yaw = prior
    expected = reach - y / cell_m, yaw / step, reach + x / cell_m
    near_prior = _near(volume.shape, expected, PRIOR_M / cell_m, PRIOR_DEG)
    highest = volume.max(0)  # a maximum along the slowest axis is fast
    allowed = jnp.where(jnp.isnan(x), highest, jnp.where(near_prior, volume, -1.0).max(0))
    turn, right = jnp.unravel_index(jnp.argmax(allowed), allowed.shape)
    column = jnp.where(near_prior[:, turn, right] | jnp.isnan(x), volume[:, turn, right], -1.0)
    cell = jnp.argmax(column), turn, right
    second = _second_peak(volume, highest, cell, cell_m, config)
    down, turn, right = (index + offset for index, offset in zip(cell, _offsets(volume, cell), strict=True))
    x, y, yaw = (right - reach) * cell_m, (reach - down) * cell_m, jnp.mod(turn * step, 2 * np.pi)
    return CorrelationPeak(x, y, yaw, volume[cell], second)


def _second_peak(
    volume: Float[Array, "d t r"],
    highest: Float[Array, "t r"],
    peak: tuple[Int[Array, ""], ...],
    cell_m: float,
    config: VerificationConfig,
) -> Float[Array, ""]:
    """Highest correlation away from a peak. `highest` is the maximum over all shifts down."""
    down, turn, right = peak
    near_turns = int(SECOND_DEG * config.turns / 360 + 1e-6)
    turns = jnp.mod(turn + np.arange(-near_turns, near_turns + 1), config.turns)
    block = volume[:, turns]
    near = _near(block.shape, (down, near_turns, right), SECOND_M / cell_m, 360.0)
    other_turns = jnp.ones(config.turns, bool).at[turns].set(False)
    return jnp.maximum(jnp.max(jnp.where(other_turns[:, None], highest, 0.0)), jnp.max(jnp.where(~near, block, 0.0)))


def _offsets(volume: Float[Array, "d t r"], peak: tuple[Int[Array, ""], ...]) -> list[Float[Array, ""]]:
    """Offset of the peak from its cell along each axis, from a parabola through three values."""
    offsets = []
    for axis, index in enumerate(peak):
        size = volume.shape[axis]
        before, after = index - 1, index + 1
        if axis != 1:  # rotations wrap around, shifts end
            before, after = jnp.maximum(before, 0), jnp.minimum(after, size - 1)
        low, best, high = (
            volume[(*peak[:axis], neighbour, *peak[axis + 1 :])] for neighbour in (before % size, index, after % size)
        )
        bend = low - 2 * best + high
        offset = (low - high) / (2 * jnp.where(bend < 0, bend, -1e9))
        offsets.append(jnp.clip(offset, -0.5, 0.5))
    return offsets


def _near(
    shape: tuple[int, ...], pose: Sequence[Float[Array, ""] | Int[Array, ""] | int], most_cells: float, most_deg: float
) -> Bool[Array, "d t r"]:
    """Whether each index (down, rotation, right) is near a pose in these units."""
    down, turn, right = (jnp.abs(jnp.arange(n) - index) for n, index in zip(shape, pose, strict=True))
    turn = jnp.mod(turn, shape[1])
    near_turn = jnp.minimum(turn, shape[1] - turn) * (360 / shape[1]) <= most_deg
    near_down, near_right = (apart <= most_cells + 1e-6 for apart in (down, right))
    return near_down[:, None, None] & near_turn[None, :, None] & near_right[None, None, :]
