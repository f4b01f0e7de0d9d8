"""Does the query fit other places as well as its match? Scans of its surroundings that certainly show other places.

Frames of the last half minute are never matches, and they come from the same surroundings as the query. So do the
frames around the match. If the query fits one of these rivals about as well as the match, the place repeats, and the
fit proves nothing. A rival that overlaps the query or the match fits it rightly, at the pose by which the sensor moved:
there only its second-best pose counts.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.loops.motion import Motion
from sglpr_jax.loops.pose_search import Peak
from sglpr_jax.loops.transforms import transform, yaw_of


@dataclasses.dataclass(frozen=True)
class RivalConfig:
    """Which frames are rivals of a match."""

    of_query: int = 6
    """Maximum number from before the query."""
    of_match: int = 4
    """Maximum number from around the match, half before and half after it."""
    age_s: tuple[float, float] = (8.0, 29.0)
    """Time between a rival and the query or the match while the sensor moved, in seconds."""
    agree_m: float = 3.0
    agree_share: float = 0.05
    """A fit agrees with the motion up to this distance, in metres, plus this share of the travelled distance."""
    agree_deg: float = 20.0


def rivals(
    distances: Float[np.ndarray, " n"],
    match: int,
    motion: Motion,
    usable: Bool[np.ndarray, " n"],
    *,
    now: float,
    config: RivalConfig = RivalConfig(),
) -> Int[np.ndarray, " k"]:
    """Choose the rivals of a match: of each stretch of time the frame whose descriptor is nearest to the query's.

    Arguments:
      distances: from the query's descriptor to those of all earlier frames.
      match: the frame of the match.
      motion: of all earlier frames.
      usable: which frames show something.
      now: the motion's clock at the query, in seconds.
      config: how many, and how old.
    """
    clock = np.array(motion.clock)
    youngest, oldest = config.age_s
    starts = [now - oldest] + [clock[match] - oldest, clock[match] + youngest]
    chosen = []
    for start, count in zip(starts, (config.of_query, config.of_match // 2, config.of_match // 2), strict=True):
        edges = np.linspace(start, start + oldest - youngest, count + 1)
        for low, high in zip(edges[:-1], edges[1:], strict=True):
            pool = np.flatnonzero(usable & (clock >= low) & (clock < high) & (clock <= now - youngest))
            if len(pool):
                chosen.append(pool[np.argmin(distances[pool])])
    return np.unique(np.array(chosen, np.int64))


def rival_share(
    peaks: Peak,
    rows: Int[np.ndarray, " k"],
    *,
    match: int,
    match_peak: Peak,
    motion: Motion,
    query: int,
    config: RivalConfig = RivalConfig(),
) -> float:
    """The best correlation of the query with a rival, at a pose that the motion does not explain, over the match's.

    NaN without rivals. `motion` knows the query, too; `peaks` are those of the query over `rows`.
    """
    if not len(rows):
        return np.nan
    match_from_query = transform(float(match_peak.x), float(match_peak.y), float(match_peak.yaw))
    by_query, known = motion.from_frame(query, rows)
    explained = known & _agree(peaks, by_query, _travelled(motion, query, rows), config)
    by_match, known = motion.from_frame(match, rows)
    explained |= known & _agree(peaks, by_match @ match_from_query, _travelled(motion, match, rows), config)
    counted = np.where(explained, np.asarray(peaks.second), np.asarray(peaks.correlation))
    return float(counted.max() / max(float(match_peak.correlation), 1e-6))


def _travelled(motion: Motion, frame: int, rows: Int[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    return np.abs(np.array([motion.travelled[row] for row in rows]) - motion.travelled[frame])


def _agree(
    peaks: Peak, rival_from_query: Float[np.ndarray, "k 4 4"], travelled: Float[np.ndarray, " k"], config: RivalConfig
) -> Bool[np.ndarray, " k"]:
    """Which peaks are where the motion puts the query."""
    apart = np.hypot(rival_from_query[:, 0, 3] - np.asarray(peaks.x), rival_from_query[:, 1, 3] - np.asarray(peaks.y))
    turned = np.asarray(peaks.yaw) - yaw_of(rival_from_query)
    turned = np.abs((turned + np.pi) % (2 * np.pi) - np.pi)
    near = apart <= config.agree_m + config.agree_share * travelled
    return np.asarray(near & (turned <= np.radians(config.agree_deg)))
