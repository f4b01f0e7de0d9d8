"""Positions, distances and revisits: what "the same place" means in metres and seconds."""

import numpy as np
from jaxtyping import Bool, Float, Int

POSITIVE_M = 3.0
"""Two scans no farther apart than this show the same place."""
NEGATIVE_M = 20.0
"""Two scans farther apart than this show different places; in between nothing is claimed."""
EXCLUDED_S = 30.0
"""A query is never matched with frames younger than this: they are neighbours, not a revisit."""
EXCLUDED_FRAMES = 290
"""What stands for EXCLUDED_S where a sequence has no times: 30 s at KITTI's 9.6 scans a second."""


def positions_from_camera(world_from_camera: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "n 3"]:
    """Return positions (n, 3) in metres, z up, from KITTI's camera poses (x right, y down, z forward).

    The camera's (x, y, z) becomes (z, -x, -y): x forward, y left, z up. It is a pure permutation, so distances in the
    camera's x and z are distances in our x and y.
    """
    x, y, z = world_from_camera[:, :, 3].astype(np.float64).T
    return np.stack([z, -x, -y], axis=1)


def distances(a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "n m"]:
    """Return the Euclidean distances (n, m) in metres, float64, between every position of `a` and every one of `b`."""
    squared = np.zeros((len(a), len(b)))
    for a_axis, b_axis in zip(a.astype(np.float64).T, b.astype(np.float64).T, strict=True):
        squared += np.subtract.outer(a_axis, b_axis) ** 2
    return np.sqrt(squared)


def database_end(
    n: int,
    *,
    times: Float[np.ndarray, " n"] | None = None,
    excluded_s: float = EXCLUDED_S,
    excluded_frames: int = EXCLUDED_FRAMES,
) -> Int[np.ndarray, " n"]:
    """Return for each of `n` frames as a query how many of the first frames are its database; 0: it is no query.

    The rule is LoGG3D-Net's. A frame in the first `excluded_s` seconds is no query. The database of any other query at
    time t is frames `[:k + 1]`, k being the first frame with a time > t - `excluded_s`; so one frame in it is a little
    younger than `excluded_s`. Without `times` (seconds) the frame number is the clock and `excluded_frames` the limit.

    Raises ValueError where times are not finite or run backwards.
    """
    clock, excluded = (np.arange(n, dtype=np.float64), excluded_frames) if times is None else (times, excluded_s)
    if not np.all(np.isfinite(clock)) or np.any(np.diff(clock) < 0):
        raise ValueError("expected finite times that never decrease, found others")
    if n == 0:
        return np.zeros(0, dtype=np.int64)
    first_younger = np.searchsorted(clock, clock - excluded, side="right")
    return np.where(clock - clock[0] < excluded, 0, np.minimum(first_younger + 1, np.arange(n)))


def revisits(
    positions: Float[np.ndarray, "n d"],
    *,
    times: Float[np.ndarray, " n"] | None = None,
    radius_m: float = POSITIVE_M,
    excluded_s: float = EXCLUDED_S,
    excluded_frames: int = EXCLUDED_FRAMES,
) -> Bool[np.ndarray, " n"]:
    """Return for each frame whether its database (see `database_end`) holds a frame within `radius_m` metres.

    `positions` with three columns give the revisits in 3-D, their first two columns alone those in 2-D.
    """
    ends = database_end(len(positions), times=times, excluded_s=excluded_s, excluded_frames=excluded_frames)
    revisited = np.zeros(len(positions), dtype=bool)
    for query in np.flatnonzero(ends):
        revisited[query] = distances(positions[query : query + 1], positions[: ends[query]]).min() <= radius_m
    return revisited
