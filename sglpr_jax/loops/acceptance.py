"""Joint acceptance of the loops of a whole drive, given the odometry and the full scans."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.mounting import upright_from_lidar
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import warn
from sglpr_jax.loops.closure import UNKNOWN_HEIGHT_M, LoopClosure, Reason, RejectedClosure, frames_of
from sglpr_jax.loops.consistency import are_consistent, largest_consistent_set
from sglpr_jax.loops.drift import deviations
from sglpr_jax.loops.frame_alignment import logarithm
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.registration.gicp import register
from sglpr_jax.se3 import inverse

MIN_OVERLAP = 0.6
"""Minimum overlap of two registered scans of one place. Measurements: docs/decisions.md."""
LITTLE_OVERLAP = 0.3
"""Minimum overlap of two registered scans of one place whose pose agrees with that of their images."""
AGREE, AGREE_M, AGREE_DEG = 6.0, 0.05, 0.3
"""Maximum distance of both poses in standard deviations of 6 degrees of freedom, and standard deviations (metres,
degrees) added to those of the poses."""
FEWEST_AGAINST = 5
"""Minimum number of frames whose loops contradict the odometry, for a warning."""
SEPARATE_M = 50.0
"""Travelled distance beyond which loops belong to different groups, in metres."""
AXES = "x forward, y left, z up, of the LiDAR, not of a camera."


def accept_loops(
    loops: Sequence[LoopClosure], path: DrivenPath, *, drift: DriftModel = DriftModel()
) -> tuple[list[LoopClosure], list[RejectedClosure]]:
    """Accept the loops of a whole drive, between gravity-aligned frames, jointly against the path by odometry.

    Loops that contradict the odometry are rejected, even if many agree with each other, because loops of repeating
    places agree with each other. Of the others the largest consistent set is accepted. Returns accepted and rejected
    loops.
    """
    fits_odometry = deviations(loops, path, drift=drift) <= drift.max_deviation
    rows = np.flatnonzero(fits_odometry)
    pairs = are_consistent([loops[row] for row in rows.tolist()], path, drift=drift)
    accepted = set(rows[largest_consistent_set(pairs)].tolist())
    reasons: tuple[Reason, Reason] = ("contradicts the odometry", "contradicts other loops")
    rejected = [
        RejectedClosure(loop, reasons[int(fits_odometry[row])]) for row, loop in enumerate(loops) if row not in accepted
    ]
    return [loops[row] for row in sorted(accepted)], rejected


def count_revisit_segments(loops: Sequence[LoopClosure], travelled_m: Float[np.ndarray, " n"]) -> int:
    """Number of groups of at least three loops whose queries and matches are more than `SEPARATE_M` apart."""
    query_m, match_m = (travelled_m[frames] for frames in frames_of(loops))
    near_query = np.abs(np.subtract.outer(query_m, query_m)) <= SEPARATE_M
    near_match = np.abs(np.subtract.outer(match_m, match_m)) <= SEPARATE_M
    _, group = connected_components(near_query | near_match, directed=False)
    return int((np.bincount(group) >= 3).sum()) if len(loops) else 0


def check_odometry(
    name: str,
    agreeing: Sequence[LoopClosure],
    against: Sequence[LoopClosure],
    path: DrivenPath,
    drift: DriftModel,
    scale: Scale,
) -> None:
    """Warn if the odometry contradicts most of the frames of a recording (`name`) that have a loop.

    Drift or repeating places can be the cause. The message names both, and the options that state a larger drift.
    Lengths of loops (those `against` are between gravity-aligned frames), path and drift are multiplied by `scale`.
    """
    agreeing_frames = {loop.query for loop in agreeing}
    contrary_frames = {loop.query for loop in against} - agreeing_frames
    frames = len(agreeing_frames) + len(contrary_frames)
    if len(contrary_frames) < FEWEST_AGAINST or 2 * len(contrary_frames) <= frames:
        return
    factor = float(f"{np.median(deviations(against, path, drift=drift)):.2g}")
    larger = drift.scaled(factor)
    pairs = are_consistent(against, path, drift=larger)
    consistent = [against[row] for row in largest_consistent_set(pairs)]
    stated, larger = drift.at_scale(1 / scale), larger.at_scale(1 / scale)
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
    """Register the scans of loops, and reject loops whose scans contradict the images.

    After `should_stop`, the remaining loops stay unchanged. The frames of the loops are rows of the two recordings,
    which may be the same. If the odometry does not measure height (`knows_height`), the storey is unknown.
    """
    accepted, rejected = [], []
    for number, loop in enumerate(loops):
        if should_stop():
            return [*accepted, *loops[number:]], rejected
        query, match = queries.points(loop.query), matches.points(loop.match)
        try:
            fine = register(query, match, initial=loop.match_from_query, initial_covariance=loop.covariance)
        except ValueError:  # too few points
            rejected.append(RejectedClosure(dataclasses.replace(loop, overlap=0.0), "little overlap"))
            continue
        registered = dataclasses.replace(loop, **fine._asdict())
        if not knows_height:  # registration does not tell equal storeys apart
            up = np.zeros(6)
            up[:3] = upright_from_lidar(queries.mounting_of(loop.query))[2, :3]
            covariance = fine.covariance + UNKNOWN_HEIGHT_M**2 * np.outer(up, up)
            registered = dataclasses.replace(registered, covariance=covariance)
        if fine.overlap >= MIN_OVERLAP or (fine.overlap >= LITTLE_OVERLAP and registration_agrees(registered, loop)):
            accepted.append(registered)
        else:
            rejected.append(RejectedClosure(registered, "little overlap"))
    return accepted, rejected


def registration_agrees(registered: LoopClosure, loop: LoopClosure) -> bool:
    """Whether the pose by the scans agrees with that by the images, within the covariances of both."""
    error = logarithm((inverse(loop.match_from_query) @ registered.match_from_query)[None])[0]
    least = np.repeat([AGREE_M, np.radians(AGREE_DEG)], 3) ** 2
    spread = loop.covariance + registered.covariance + np.diag(least)
    return bool(error @ np.linalg.solve(spread, error) <= AGREE**2)
