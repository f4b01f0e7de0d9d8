"""Lines for surroundings where places repeat: roads, rings and rows, and the path of a vehicle along them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from sglpr_jax.sim.routes import Revisit, resampled, travelled

STEP_M = 0.1
"""Distance between two points of a line, in metres."""
MARGIN_M = 90.0
"""Length of a road before the first and after the last scan, in metres. It hides the ends of the road."""
LAPS = 1.5
"""Number of laps along a closed line for revisits in the same direction."""
SWAY_WAVELENGTH_M = (15.0, 60.0)

Line = Float[np.ndarray, "_ 2"]


class Rows(NamedTuple):
    """Path through parallel rows along x. Row k is at y = k * pitch, from x = 0 to `run_m`."""

    line: Line
    count: int
    run_m: float


def road(rng: np.random.Generator, length_m: float, closed: bool) -> tuple[Line, Line]:
    """Road and its driven part: a straight line or an arc with MARGIN_M at both ends, or a closed ring."""
    if closed:
        line = ring(length_m, straight=rng.uniform(0, 0.5))
        return line, line
    turn = rng.choice((0.0, rng.uniform(-2.5, 2.5)))
    line = _integrated(np.full(round((length_m + 2 * MARGIN_M) / STEP_M), turn / length_m))
    margin = round(MARGIN_M / STEP_M)
    return line, line[margin:-margin]


def ring(length_m: float, *, straight: float) -> Line:
    """Closed line of two straight parts and two half circles.

    The straight parts together are the fraction `straight` of the length.
    """
    count = round(length_m * straight / 2 / STEP_M), round(length_m * (1 - straight) / 2 / STEP_M)
    half = np.repeat([0.0, np.pi / (count[1] * STEP_M)], count)
    return _integrated(np.tile(half, 2))


def _integrated(curvature: Float[np.ndarray, " n"]) -> Line:
    """Line that starts at the origin along x, with the given curvature (1 / metres) at each point."""
    heading = np.cumsum(curvature) * STEP_M
    return np.cumsum(STEP_M * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)


def rounded(corners: Line, *, corner_m: float, closed: bool = False) -> Line:
    """Polygon through `corners`, rounded by a Gaussian with standard deviation `corner_m`."""
    polygon = resampled(np.concatenate([corners, corners[:1]]) if closed else corners, STEP_M)
    polygon = polygon[:-1] if closed else polygon
    line = gaussian_filter1d(polygon, corner_m / STEP_M, axis=0, mode="wrap" if closed else "nearest")
    return resampled(line, STEP_M)


def rows(length_m: float, *, run_m: float, pitch_m: float, closed: bool, back_m: float, corner_m: float) -> Rows:
    """Path of about `length_m` metres back and forth through rows of about `run_m` metres.

    A closed path returns from the last row to the first at x = -`back_m`.
    """
    if closed:
        count = 2 * max(1, round((length_m - 2 * back_m) / (run_m + 2 * pitch_m) / 2))
        run_m = (length_m - 2 * back_m - 2 * (count - 1) * pitch_m) / count
    else:
        count = int(np.ceil(length_m / (run_m + pitch_m))) + 1
    ends = [(x, k * pitch_m) for k in range(count) for x in ((0.0, run_m), (run_m, 0.0))[k % 2]]
    if closed:
        line = rounded(np.array([*ends, (-back_m, ends[-1][1]), (-back_m, 0.0)]), corner_m=corner_m, closed=True)
        return Rows(line, count, run_m)
    return Rows(rounded(np.array(ends), corner_m=corner_m)[: round(length_m / STEP_M)], count, run_m)


def shifted(line: Line, left_m: Float[np.ndarray, " n"] | float) -> Line:
    """Shifts `line` to the left by `left_m` metres."""
    ahead = np.gradient(line, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return line + np.reshape(left_m, (-1, 1)) * np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)


def way(rng: np.random.Generator, line: Line, revisit: Revisit, *, right_m: float, sway_m: float) -> Line:
    """Path of a vehicle `right_m` metres to the right of `line`, with a sway of up to `sway_m` metres.

    With revisit "opposite", the vehicle turns at the end and returns. With "same", it drives LAPS laps, and `line`
    must be closed.
    """
    if revisit == "same":
        line = np.concatenate([line, line[: round((LAPS - 1) * len(line))]])
    out = shifted(line, -right_m)
    if revisit == "opposite":
        out = np.concatenate([out, _turn(line, right_m), shifted(line[::-1], -right_m)])
    out = resampled(out, STEP_M)
    return resampled(shifted(out, sway_m * _waves(rng, travelled(out))), STEP_M)


def _turn(line: Line, radius_m: float) -> Line:
    """Half circle to the left around the end of `line`."""
    ahead = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    angle = np.linspace(-np.pi / 2, np.pi / 2, 2 + round(np.pi * radius_m / STEP_M))[1:-1, None]
    return line[-1] + radius_m * (np.cos(angle) * ahead + np.sin(angle) * np.array([-ahead[1], ahead[0]]))


def _waves(rng: np.random.Generator, length: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Slowly varying random values along a path, between -1 and 1."""
    wavelengths, phases = rng.uniform(*SWAY_WAVELENGTH_M, 3), rng.uniform(0, 2 * np.pi, 3)
    return np.sin(2 * np.pi * length[:, None] / wavelengths + phases).mean(axis=1)
