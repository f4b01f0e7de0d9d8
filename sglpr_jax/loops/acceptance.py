"""Joint acceptance of the loops of a whole drive, given the odometry and the full scans."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.mounting import upright_from_lidar
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.warning import warn
from sglpr_jax.loops.closure import UNKNOWN_HEIGHT_M, LoopClosure, Reason, RejectedClosure, frames_of, scaled_drift
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.consistency import agree, largest_consistent_set
from sglpr_jax.loops.drift import deviations
from sglpr_jax.loops.frame_alignment import logarithm
from sglpr_jax.odometry.config import DriftModel
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


def accepted(
    loops: Sequence[LoopClosure],
    path: DrivenPath,
    *,
    drift: DriftModel = DriftModel(),
) -> tuple[list[LoopClosure], list[RejectedClosure]]:
    """Accept the loops of a whole drive, between gravity-aligned frames, jointly against the path by odometry.

    Loops that contradict the odometry are rejected, even if many agree with each other, because loops of repeating
    places agree with each other. Of the others the largest consistent set is accepted. Returns accepted and rejected
    loops.
    """
    fits = deviations(loops, path, drift=drift) <= drift.max_deviation
    left = np.flatnonzero(fits).tolist()
    pairs = agree([loops[i] for i in left], path, drift=drift)
    members = {left[i] for i in largest_consistent_set(pairs)}
    reasons: tuple[Reason, Reason] = ("contradicts the odometry", "contradicts other loops")
    rejected = [RejectedClosure(loop, reasons[int(fits[i])]) for i, loop in enumerate(loops) if i not in members]
    return [loops[i] for i in sorted(members)], rejected


def count_revisit_segments(loops: Sequence[LoopClosure], way: Float[np.ndarray, " n"]) -> int:
    """Number of groups of at least three loops whose queries and matches are more than `SEPARATE_M` apart."""
    query, match = frames_of(loops)
    near = [np.abs(np.subtract.outer(way[frames], way[frames])) <= SEPARATE_M for frames in (query, match)]
    _, group = connected_components(near[0] | near[1], directed=False)
    return int((np.bincount(group) >= 3).sum()) if len(loops) else 0


def check_odometry(
    name: str,
    agreeing: Sequence[LoopClosure],
    against: Sequence[LoopClosure],
    path: DrivenPath,
    config: DetectorConfig,
    scale: Scale,
) -> None:
    """Warn if the odometry contradicts most of the frames of a recording (`name`) that have a loop.

    Drift or repeating places can be the cause. The message names both, and the options that state a larger drift.
    Loops (those `against` are between gravity-aligned frames), path and settings were multiplied by `scale`.
    """
    frames = {one.query for one in agreeing}
    contrary = {one.query for one in against} - frames
    frames |= contrary
    if len(contrary) < FEWEST_AGAINST or 2 * len(contrary) <= len(frames):
        return
    found = deviations(against, path, drift=config.drift)
    drift = config.drift.scaled(float(f"{np.median(found):.2g}"))
    pairs = agree(against, path, drift=drift)
    members = [against[i] for i in largest_consistent_set(pairs)]
    stated, drift = (scaled_drift(one, 1 / scale) for one in (config.drift, drift))
    percent, degrees = 100 * drift.metres_per_metre, 100 * drift.degrees_per_metre
    warn(
        f"{name}: the odometry contradicts the loops of {len(contrary)} of {len(frames)} frames, which are rejected. "
        f"Either places repeat, or the odometry drifts by about {drift}, not by {stated}: {len(members)} of "
        f"{len(against)} loops would then be consistent (separate parts of the drive with at least three of them: "
        f"{count_revisit_segments(members, path.travelled)}). If it drifts that much, state it: --drift-percent "
        f"{percent:.3g} --drift-deg-per-100m {degrees:.3g}. Check also that the poses belong to these scans and use "
        f"these axes: {AXES}"
    )


def registered_loops(
    queries: Recording,
    matches: Recording,
    loops: list[LoopClosure],
    *,
    knows_height: bool = True,
    should_stop: Callable[[], bool],
) -> tuple[list[LoopClosure], list[RejectedClosure]]:
    """Registered loops, and those whose scans contradict the images. After `should_stop`, the others are unchanged.

    The frames of the loops are rows of the two recordings, which may be the same. If the odometry does not measure
    height (`knows_height`), the storey is unknown.
    """
    kept, rejected = [], []
    for i, loop in enumerate(loops):
        if should_stop():
            return [*kept, *loops[i:]], rejected
        query, match = queries.points(loop.query), matches.points(loop.match)
        try:
            found = register(query, match, initial=loop.match_from_query, initial_covariance=loop.covariance)
        except ValueError:  # too few points
            rejected.append(RejectedClosure(dataclasses.replace(loop, overlap=0.0), "little overlap"))
            continue
        fine = dataclasses.replace(loop, **found._asdict())
        if not knows_height:  # registration does not tell equal storeys apart
            up = np.zeros(6)
            up[:3] = upright_from_lidar(queries.mounting_of(loop.query))[2, :3]
            fine = dataclasses.replace(fine, covariance=fine.covariance + UNKNOWN_HEIGHT_M**2 * np.outer(up, up))
        if found.overlap >= MIN_OVERLAP or (found.overlap >= LITTLE_OVERLAP and registration_agrees(fine, loop)):
            kept.append(fine)
        else:
            rejected.append(RejectedClosure(fine, "little overlap"))
    return kept, rejected


def registration_agrees(fine: LoopClosure, loop: LoopClosure) -> bool:
    """Whether the pose by the scans agrees with that by the images, within the covariances of both."""
    error = logarithm((inverse(loop.match_from_query) @ fine.match_from_query)[None])[0]
    least = np.repeat([AGREE_M, np.radians(AGREE_DEG)], 3) ** 2
    spread = loop.covariance + fine.covariance + np.diag(least)
    return bool(error @ np.linalg.solve(spread, error) <= AGREE**2)
