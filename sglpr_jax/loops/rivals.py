"""Rivals of a match: scans of the same surroundings that certainly show other places.

Frames of the last half minute are never matches, and they show the surroundings of the query. The frames around the
match show the surroundings of the match. If the query fits one of these rivals about as well as the match, the place
repeats, and the fit proves nothing. A rival that overlaps the query or the match fits it correctly at the pose given by
the motion. At that pose, only the second-best fit counts.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.loops.config import RivalConfig
from sglpr_jax.loops.motion import Motion
from sglpr_jax.loops.pose_search import Peak
from sglpr_jax.loops.transforms import yaw_of

MAP_RIVALS = 10
"""Maximum number of rivals of a match in a map."""
RIVAL_SPACING_M = 8.0
"""Minimum distance between rivals in a map, and from rivals to the match, in metres."""


def rivals(
    descriptor: Float[np.ndarray, " d"],
    descriptors: Float[np.ndarray, "n d"],
    frames: Int[np.ndarray, " n"],
    match: int,
    motion: Motion,
    *,
    exclude_s: float,
    config: RivalConfig = RivalConfig(),
) -> Int[np.ndarray, " k"]:
    """Choose the rivals of a match: from each time interval, the frame whose descriptor is nearest to the query's.

    Arguments:
      descriptor: Descriptor of the query.
      descriptors: Descriptors of the stored scans.
      frames: Frame of each stored scan.
      match: Frame of the match.
      motion: Motion of all earlier frames and the query.
      exclude_s: Minimum age of a match, in seconds.
      config: Number and age of the rivals.

    Returns:
      Rows of stored scans, in order.
    """
    clock, now = motion.clock[frames], motion.clock[-1]
    youngest, oldest = (share * exclude_s for share in config.age)
    starts = (now - oldest, motion.clock[match] - oldest, motion.clock[match] + youngest)
    counts = (config.of_query, config.of_match // 2, config.of_match // 2)
    clock = np.where(clock <= now - youngest, clock, np.inf)
    return _nearest_in_time(descriptor, descriptors, clock, starts, counts, oldest - youngest)


def rivals_around(
    descriptor: Float[np.ndarray, " d"],
    descriptors: Float[np.ndarray, "n d"],
    frames: Int[np.ndarray, " n"],
    frame: int,
    motion: Motion,
    *,
    count: int,
    exclude_s: float,
    config: RivalConfig = RivalConfig(),
) -> Int[np.ndarray, " k"]:
    """Choose rivals as `rivals` does, `count` of them around one frame, half before and half after it."""
    clock, now = motion.clock[frames], motion.clock[frame]
    youngest, oldest = (share * exclude_s for share in config.age)
    starts, counts = (now - oldest, now + youngest), (count // 2, count // 2)
    return _nearest_in_time(descriptor, descriptors, clock, starts, counts, oldest - youngest)


def _nearest_in_time(
    descriptor: Float[np.ndarray, " d"],
    descriptors: Float[np.ndarray, "n d"],
    clock: Float[np.ndarray, " n"],
    starts: Sequence[float],
    counts: Sequence[int],
    seconds: float,
) -> Int[np.ndarray, " k"]:
    """Rows of the nearest descriptors in equal parts of some intervals. Interval i has `counts[i]` parts."""
    chosen = []
    for start, count in zip(starts, counts, strict=True):
        for low, high in itertools.pairwise(np.linspace(start, start + seconds, count + 1)):
            pool = np.flatnonzero((clock >= low) & (clock < high))
            if len(pool):
                chosen.append(pool[np.linalg.norm(descriptors[pool] - descriptor, axis=1).argmin()])
    return np.unique(np.array(chosen, np.int64))


def rival_places(
    apart: Float[np.ndarray, " n"], positions: Float[np.ndarray, "n 3"], match: int
) -> Int[np.ndarray, " k"]:
    """Choose the rivals of a match in a map: the places with the nearest descriptors, at least `RIVAL_SPACING_M` apart.

    Arguments:
      apart: Distance of the query's descriptor to that of each place.
      positions: Position of each place, in metres.
      match: Row of the match.

    Returns:
      Rows, the nearest descriptor first.
    """
    left, chosen = apart.copy(), [match]
    for _ in range(MAP_RIVALS):
        left[np.linalg.norm(positions - positions[chosen[-1]], axis=1) < RIVAL_SPACING_M] = np.inf
        if not np.isfinite(left).any():
            break
        chosen.append(int(left.argmin()))
    return np.array(chosen[1:], np.int64)


def rival_share(
    peaks: Peak,
    match_correlation: float,
    expected: Sequence[tuple[Float[np.ndarray, "k 4 4"], Float[np.ndarray, " k"]]],
    *,
    config: RivalConfig = RivalConfig(),
) -> float:
    """Best correlation of a query with a rival, divided by its correlation with the match. NaN without rivals.

    Arguments:
      peaks: Peaks of the query over k rivals.
      match_correlation: Correlation of the query with its match.
      expected: Poses of the query in the frames of the rivals according to the motion, with tolerances in metres (NaN
        if the pose is unknown). A peak at an expected pose does not show repetition. The second peak counts instead.
      config: Angle within which a peak agrees with the expected pose.
    """
    if not len(peaks.correlation):
        return np.nan
    explained = np.zeros(len(peaks.correlation), bool)
    for poses, tolerance_m in expected:
        apart = np.hypot(poses[:, 0, 3] - np.asarray(peaks.x), poses[:, 1, 3] - np.asarray(peaks.y))
        rotation = np.asarray(peaks.yaw) - yaw_of(poses)
        rotation = np.abs((rotation + np.pi) % (2 * np.pi) - np.pi)
        explained |= (apart <= tolerance_m) & (rotation <= np.radians(config.agree_deg))
    counted = np.where(explained, np.asarray(peaks.second), np.asarray(peaks.correlation))
    return float(counted.max() / max(match_correlation, 1e-6))


def distance_share(
    distance: float,
    rival_distances: Float[np.ndarray, " k"],
    expected: Sequence[tuple[Float[np.ndarray, "k 4 4"], Float[np.ndarray, " k"]]],
    *,
    config: RivalConfig = RivalConfig(),
) -> float:
    """Descriptor distance of a query to its match, divided by its distance to the nearest rival. NaN without rivals.

    Rivals that overlap the query according to the `expected` poses (see `rival_share`) do not count.
    """
    overlaps = np.zeros(len(rival_distances), bool)
    for poses, tolerance_m in expected:
        overlaps |= np.isfinite(tolerance_m) & (np.hypot(poses[:, 0, 3], poses[:, 1, 3]) < config.overlap_m)
    apart = rival_distances[~overlaps]
    return float(distance / max(apart.min(), 1e-6)) if len(apart) else np.nan


def expected_poses(
    motion: Motion,
    frame: int,
    rows: Int[np.ndarray, " k"],
    frame_from_query: Float[np.ndarray, "4 4"],
    *,
    config: RivalConfig = RivalConfig(),
) -> tuple[Float[np.ndarray, "k 4 4"], Float[np.ndarray, " k"]]:
    """Return the expected pose of the query in the frame of each rival, with tolerances, as input for `rival_share`.

    The query's pose is known relative to the scan `frame`.
    """
    poses, known = motion.from_frame(frame, rows)
    travelled = np.abs(motion.travelled[rows] - motion.travelled[frame])
    tolerance = np.where(known, config.agree_m + config.agree_share * travelled, np.nan)
    return poses @ frame_from_query, tolerance
