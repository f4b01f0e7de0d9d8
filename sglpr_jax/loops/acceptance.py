"""Joint acceptance of the loops of a whole drive, given the odometry and the full scans."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.levelling import AnyMounting, mountings_of, upright_from_lidar
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.warning import warn
from sglpr_jax.loops.closure import UNKNOWN_HEIGHT_M, Loop, Reason, Rejected, frames_of, scaled_drift
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.consistency import agree, largest_consistent_set
from sglpr_jax.loops.drift import deviations
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.registration.gicp import register
from sglpr_jax.se3 import inverse, travelled

MIN_OVERLAP = 0.6
"""Minimum overlap of two registered scans of one place. Measurements: docs/decisions.md."""
LITTLE_OVERLAP = 0.3
"""Minimum overlap of two registered scans of one place whose pose agrees with that of their images."""
AGREE, AGREE_M, AGREE_DEG = 6.0, 0.05, 0.3
"""Maximum distance of both poses in standard deviations of 6 degrees of freedom, and standard deviations (metres,
degrees) added to those of the poses."""
FEWEST_AGAINST = 5
"""Minimum number of frames whose loops contradict the odometry, for a warning."""
AXES = "x forward, y left, z up, of the LiDAR, not of a camera."


def accepted(
    loops: Sequence[Loop],
    odometry: Float[np.ndarray, "n 4 4"],
    *,
    mounting: AnyMounting = None,
    drift: DriftModel = DriftModel(),
) -> tuple[list[Loop], list[Rejected]]:
    """Accept the loops of a whole drive jointly against the odometry.

    Loops that contradict the odometry are rejected, even if many agree with each other, because loops of repeating
    places agree with each other. Of the remaining loops the largest consistent set is accepted.

    Returns:
      The accepted and the rejected loops, each in the given order.
    """
    path = DrivenPath.of(odometry, mounting=mounting)
    fits = deviations(loops, path, drift=drift, mounting=mounting) <= drift.max_deviation
    left = np.flatnonzero(fits).tolist()
    pairs = agree([loops[i] for i in left], path, mounting=mounting, drift=drift)
    members = {left[i] for i in largest_consistent_set(pairs)}
    reasons: tuple[Reason, Reason] = ("contradicts the odometry", "contradicts other loops")
    rejected = [Rejected(loop, reasons[int(fits[i])]) for i, loop in enumerate(loops) if i not in members]
    return [loops[i] for i in sorted(members)], rejected


def stretches(
    loops: Sequence[Loop], odometry: Float[np.ndarray, "n 4 4"], *, apart_m: float = 50.0, fewest: int = 3
) -> int:
    """Number of groups of at least `fewest` loops whose queries and matches are more than `apart_m` metres apart."""
    way, (query, match) = travelled(odometry), frames_of(loops)
    near = [np.abs(np.subtract.outer(way[frames], way[frames])) <= apart_m for frames in (query, match)]
    _, group = connected_components(near[0] | near[1], directed=False)
    return int((np.bincount(group) >= fewest).sum()) if len(loops) else 0


def check_odometry(
    name: str,
    loops: Sequence[Loop],
    rejected: Sequence[Rejected],
    odometry: Float[np.ndarray, "n 4 4"],
    config: DetectorConfig,
    mounting: AnyMounting = None,
    scale: Scale = 1,
) -> None:
    """Warns if the odometry contradicts most of the frames that have a loop.

    Both drift and repeating places can be the cause. The message names both, and the options that state a larger drift.

    Arguments:
      name: Name of the recording.
      loops: Accepted loops.
      rejected: Rejected loops.
      odometry: Pose of the LiDAR at each frame.
      config: Settings of the detector.
      mounting: Mounting of the LiDAR, or that at each frame.
      scale: Factor by which loops, odometry and settings were multiplied.
    """
    against = [one.loop for one in rejected if one.reason == "contradicts the odometry"]
    agreeing = {one.query for one in loops}
    contrary = {one.query for one in against} - agreeing
    frames = contrary | agreeing
    if len(contrary) < FEWEST_AGAINST or 2 * len(contrary) <= len(frames):
        return
    said = f"{name}: the odometry contradicts the loops of {len(contrary)} of {len(frames)} frames, which are rejected."
    said += f" {_readings(against, odometry, config, mounting, scale)}"
    warn(f"{said} Check also that the poses belong to these scans and use these axes: {AXES}")


def _readings(
    against: Sequence[Loop],
    odometry: Float[np.ndarray, "n 4 4"],
    config: DetectorConfig,
    mounting: AnyMounting,
    scale: Scale,
) -> str:
    """Both explanations of loops that contradict the odometry, with the drift that would explain them."""
    path = DrivenPath.of(odometry, mounting=mounting)
    found = deviations(against, path, drift=config.drift, mounting=mounting)
    drift = config.drift.scaled(float(f"{np.median(found):.2g}"))
    pairs = agree(against, path, mounting=mounting, drift=drift)
    members = [against[i] for i in largest_consistent_set(pairs)]
    stated, drift = (scaled_drift(one, 1 / scale) for one in (config.drift, drift))
    percent, degrees = 100 * drift.metres_per_metre, 100 * drift.degrees_per_metre
    return (
        f"Either places repeat, or the odometry drifts by about {drift}, not by {stated}: {len(members)} of "
        f"{len(against)} loops would then be consistent (separate parts of the drive with at least three of them: "
        f"{stretches(members, odometry)}). If it drifts that much, state it: --drift-percent {percent:.3g} "
        f"--drift-deg-per-100m {degrees:.3g}."
    )


def settled(
    recording: Recording,
    loops: Sequence[Loop],
    odometry: Float[np.ndarray, "n 4 4"] | None,
    config: DetectorConfig,
    *,
    registered: bool,
    knows_height: bool = True,
    should_stop: Callable[[], bool] = lambda: False,
) -> tuple[list[Loop], list[Rejected]]:
    """Accept the loops of a whole drive jointly and, with `registered`, check the overlap of their scans.

    If `should_stop` returns True, the remaining loops are kept without registration. Without odometry, no loop is
    rejected as inconsistent.

    Returns:
      The accepted and the rejected loops.
    """
    kept, rejected = list(loops), []
    if odometry is not None:
        kept, rejected = accepted(loops, odometry, mounting=mountings_of(recording), drift=config.drift)
    if registered:
        options = {"knows_height": knows_height, "should_stop": should_stop}
        kept, others = registered_loops(recording, recording, kept, **options)
        rejected = rejected + others
    return kept, rejected


def registered_loops(
    queries: Recording,
    matches: Recording,
    loops: list[Loop],
    *,
    knows_height: bool = True,
    should_stop: Callable[[], bool],
) -> tuple[list[Loop], list[Rejected]]:
    """Registered loops, and loops whose scans contradict the images. After a stop, the others are unchanged.

    Arguments:
      queries: Recording of the queries.
      matches: Recording of the matches, which may be the same.
      loops: Loops, with the rows of these recordings.
      knows_height: Whether the odometry measures height. If not, the storey is unknown.
      should_stop: If it returns True, no further loop is registered.
    """
    kept, rejected = [], []
    for i, loop in enumerate(loops):
        if should_stop():
            return [*kept, *loops[i:]], rejected
        query, match = queries.points(loop.query), matches.points(loop.match)
        try:
            found = register(query, match, initial=loop.match_from_query, initial_covariance=loop.covariance)
        except ValueError:  # too few points
            rejected.append(Rejected(dataclasses.replace(loop, overlap=0.0), "little overlap"))
            continue
        fine = dataclasses.replace(loop, **found._asdict())
        if not knows_height:  # registration does not tell equal storeys apart
            up = np.zeros(6)
            up[:3] = upright_from_lidar(queries.mounting_of(loop.query))[2, :3]
            fine = dataclasses.replace(fine, covariance=fine.covariance + UNKNOWN_HEIGHT_M**2 * np.outer(up, up))
        if found.overlap >= MIN_OVERLAP or (found.overlap >= LITTLE_OVERLAP and agrees(fine, loop)):
            kept.append(fine)
        else:
            rejected.append(Rejected(fine, "little overlap"))
    return kept, rejected


def agrees(fine: Loop, loop: Loop) -> bool:
    """Whether the pose by the scans agrees with that by the images, within the covariances of both."""
    apart = inverse(loop.match_from_query) @ fine.match_from_query
    error = np.concatenate([apart[:3, 3], Rotation.from_matrix(apart[:3, :3]).as_rotvec()])
    least = np.repeat([AGREE_M, np.radians(AGREE_DEG)], 3) ** 2
    spread = loop.covariance + fine.covariance + np.diag(least)
    return bool(error @ np.linalg.solve(spread, error) <= AGREE**2)
