"""Joint acceptance of the loops of a whole drive, given the odometry and the full scans."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Float32
from scipy.sparse.csgraph import connected_components

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import warn
from sglpr_jax.loops.closure import (
    UNKNOWN_HEIGHT_M,
    LoopClosure,
    Reason,
    RejectedClosure,
    frames_of,
    to_lidar,
    to_upright,
)
from sglpr_jax.loops.consistency import are_consistent, largest_consistent_set
from sglpr_jax.loops.frame_alignment import logarithm
from sglpr_jax.loops.odometry_deviation import deviations
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.registration.gicp import register
from sglpr_jax.se3 import inverse

MIN_OVERLAP = 0.6
"""Minimum overlap of two registered scans of one place. Measurements: docs/decisions.md."""
LITTLE_OVERLAP = 0.3
"""Minimum overlap of two registered scans of one place whose pose agrees with that of their images."""
AGREE, AGREE_M, AGREE_DEG = 6.0, 0.05, 0.3
"""Maximum Mahalanobis distance of two poses that agree, and standard deviations (metres, degrees) added to both."""
MIN_CONTRARY_FRAMES = 5
"""Minimum number of frames whose loops contradict the odometry, for a warning."""
SEPARATE_M = 50.0
"""Travelled distance beyond which loops belong to different segments, in metres."""
AXES = "x forward, y left, z up, of the LiDAR, not of a camera."
"""Axes of odometry, for messages."""


def accept_loops(
    loops: Sequence[LoopClosure], path: DrivenPath, *, drift: DriftModel = DriftModel()
) -> tuple[list[LoopClosure], list[RejectedClosure]]:
    """Accept the largest consistent set of the loops of a whole drive that do not contradict the odometry.

    Loops that contradict the odometry are rejected even if many agree with each other, because loops of repeating
    places do. `loops` are between gravity-aligned frames of `path`. Returns accepted and rejected loops.
    """
    fits_odometry = deviations(loops, path, drift=drift) <= drift.max_deviation
    fitting_rows = np.flatnonzero(fits_odometry)
    pairs = are_consistent([loops[row] for row in fitting_rows.tolist()], path, drift=drift)
    accepted_rows = set(fitting_rows[largest_consistent_set(pairs)].tolist())
    accepted, rejected = [], []
    for row, loop in enumerate(loops):
        reason: Reason = "contradicts other loops" if fits_odometry[row] else "contradicts the odometry"
        if row in accepted_rows:
            accepted.append(loop)
        else:
            rejected.append(RejectedClosure(loop, reason))
    return accepted, rejected


def count_revisit_segments(loops: Sequence[LoopClosure], travelled_m: Float[np.ndarray, " n"]) -> int:
    """Number of revisited segments with at least three loops.

    Two loops are of one segment if their queries or their matches are at most `SEPARATE_M` of travelled distance apart.
    """
    if not loops:
        return 0
    query_m, match_m = (travelled_m[frames] for frames in frames_of(loops))
    near_query = np.abs(np.subtract.outer(query_m, query_m)) <= SEPARATE_M
    near_match = np.abs(np.subtract.outer(match_m, match_m)) <= SEPARATE_M
    _, segment_of_loop = connected_components(near_query | near_match, directed=False)
    return int((np.bincount(segment_of_loop) >= 3).sum())


def check_odometry(
    name: str,
    agreeing: Sequence[LoopClosure],
    against: Sequence[LoopClosure],
    path: DrivenPath,
    drift: DriftModel,
    scale: Scale,
) -> None:
    """Warn if the odometry contradicts most of the frames that have a loop, because it drifts or because places repeat.

    `name` is that of the recording. Loops `agreeing` with the odometry and loops `against` it are between
    gravity-aligned frames of the path. Lengths of loops, path and drift are multiplied by `scale`, and those of the
    message are in metres.
    """
    agreeing_frames = {loop.query for loop in agreeing}
    contrary_frames = {loop.query for loop in against} - agreeing_frames
    frames = len(agreeing_frames) + len(contrary_frames)
    if len(contrary_frames) < MIN_CONTRARY_FRAMES or 2 * len(contrary_frames) <= frames:
        return
    factor = float(f"{np.median(deviations(against, path, drift=drift)):.2g}")  # of two significant digits
    larger_drift = drift.scaled(factor)
    pairs = are_consistent(against, path, drift=larger_drift)
    consistent = [against[row] for row in largest_consistent_set(pairs)]
    stated, larger = drift.at_scale(1 / scale), larger_drift.at_scale(1 / scale)
    percent, degrees = 100 * larger.metres_per_metre, 100 * larger.degrees_per_metre
    warn(
        f"{name}: the odometry contradicts the loops of {len(contrary_frames)} of {frames} frames, which are rejected. "
        f"Either places repeat, or the odometry drifts by about {larger}, not by {stated}: {len(consistent)} of "
        f"{len(against)} loops would then be consistent (separate parts of the drive with at least three of them: "
        f"{count_revisit_segments(consistent, path.travelled)}). If it drifts that much, state it: --drift-percent "
        f"{percent:.3g} --drift-deg-per-100m {degrees:.3g}. Check also that the poses belong to these scans and use "
        f"these axes: {AXES}"
    )


def register_loops(
    queries: Recording,
    matches: Recording,
    loops: list[LoopClosure],
    *,
    knows_height: bool = True,
    should_stop: Callable[[], bool],
) -> tuple[list[LoopClosure], list[RejectedClosure]]:
    """Register the scans of loops in 6 degrees of freedom, and reject loops whose scans overlap too little.

    The frames of the loops are rows of the recordings of queries and matches, which may be the same. If the odometry
    does not measure height (`knows_height`), the storey is unknown. After `should_stop`, the remaining loops are
    accepted unchanged. Returns accepted and rejected loops.
    """
    accepted, rejected = [], []
    for number, loop in enumerate(loops):
        if should_stop():
            return [*accepted, *loops[number:]], rejected
        query, query_rotation = _rotated_upright(queries, loop.query)
        match, match_rotation = _rotated_upright(matches, loop.match)
        rotations = {"query": query_rotation, "match": match_rotation}
        upright = to_upright(loop, **rotations)
        try:
            options = {"initial": upright.match_from_query, "initial_covariance": upright.covariance}
            registration = register(query, match, **options)
        except ValueError:  # too few points
            rejected.append(RejectedClosure(dataclasses.replace(loop, overlap=0.0), "little overlap"))
            continue
        if not knows_height:  # registration does not tell equal storeys apart
            registration.covariance[2, 2] += UNKNOWN_HEIGHT_M**2
        overlap, registered = registration.overlap, dataclasses.replace(upright, **registration._asdict())
        if overlap >= MIN_OVERLAP or (overlap >= LITTLE_OVERLAP and registration_agrees(registered, upright)):
            accepted.append(to_lidar(registered, **rotations))
        else:
            rejected.append(RejectedClosure(to_lidar(registered, **rotations), "little overlap"))
    return accepted, rejected


def _rotated_upright(recording: Recording, row: int) -> tuple[Float32[np.ndarray, "n 3"], Mounting | None]:
    """Points of a scan, rotated about the sensor to be gravity-aligned, and a mounting that stands for the rotation."""
    points, mounting = recording.points(row), recording.mounting_of(row)
    if mounting is None:
        return points, None
    rotation = dataclasses.replace(mounting, height_m=MODEL_HEIGHT_M)  # at this height, points are not shifted
    return rotation.level(points), rotation


def registration_agrees(registered: LoopClosure, loop: LoopClosure) -> bool:
    """Whether the pose of a loop by its scans agrees with that by its images, within the covariances of both."""
    error = logarithm((inverse(loop.match_from_query) @ registered.match_from_query)[None])[0]
    least = np.repeat([AGREE_M, np.radians(AGREE_DEG)], 3) ** 2
    covariance = loop.covariance + registered.covariance + np.diag(least)
    return bool(error @ np.linalg.solve(covariance, error) <= AGREE**2)
