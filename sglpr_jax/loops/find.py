"""All loops of a recording: the detector over its scans, then what only the whole drive can tell."""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.loops.consistency import agree, largest_consistent_set
from sglpr_jax.loops.detector import DetectorConfig, LoopDetector
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.probability import LoopModel
from sglpr_jax.loops.registration import register
from sglpr_jax.models.params import Params

MIN_OVERLAP = 0.6
"""Registered scans that share less of their space show two places. Measured: docs/decisions/loops.md."""


@dataclasses.dataclass(frozen=True, eq=False)
class FoundLoops:
    """The loops of a recording, and the trajectory that they belong to."""

    recording: Recording
    frames: int
    """So many of the recording's scans were looked at: all, unless it was stopped."""
    loops: tuple[Loop, ...]
    refused: tuple[Loop, ...]
    """Pairs that were called loops first, but agree with too few others, or do not overlap."""
    odometry: Float[np.ndarray, "n 4 4"] | None
    """Of all of the recording's scans."""

    def __str__(self) -> str:
        found = f"{len(self.loops)} loops in {self.frames} of {len(self.recording)} frames of {self.recording.name}"
        return f"{found}, {len(self.refused)} refused afterwards"


def find_loops(
    recording: Recording,
    params: Params,
    *,
    odometry: Float[np.ndarray, "n 4 4"] | None = None,
    model: LoopModel | None = None,
    config: DetectorConfig = DetectorConfig(),
    registered: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> FoundLoops:
    """Find the loops of a recording.

    With `odometry`, a pose for each scan (LiDAR frame, drifting as it may), candidates too far from it are left out,
    and of the loops found the largest set is kept in which all agree. With `registered` the pose of each loop is made
    one in 6 degrees of freedom from its full scans (extra `slam`), and loops of little overlap are refused. Ends early,
    with what was found, when `should_stop` says so. `on_progress` is told how many scans are done. Raises ValueError
    for odometry of another length, and what reading the scans raises.

    Example:
      found = find_loops(sglpr_jax.open_recording(root, "08"), sglpr_jax.load("simulated"))
    """
    if odometry is not None and len(odometry) != len(recording):
        raise ValueError(
            f"expected odometry of {len(recording)} poses, one for each scan of {recording.name}, found {len(odometry)}"
        )
    if registered and recording.has_images:
        raise ValueError(f"sequence {recording.name}: expected scans to register, found ready-made images")
    detector = LoopDetector(params, model=model, config=config)
    for i in range(len(recording)):
        if should_stop():
            break
        detector.add(
            recording.record(i, labels=False),
            time=None if recording.times is None else float(recording.times[i]),
            odometry=None if odometry is None else odometry[i],
        )
        on_progress(i + 1)
    kept, refused = settled(recording, detector.loops, odometry, config, registered=registered)
    return FoundLoops(recording, len(detector), tuple(kept), tuple(refused), odometry)


def settled(
    recording: Recording,
    loops: list[Loop],
    odometry: Float[np.ndarray, "n 4 4"] | None,
    config: DetectorConfig,
    *,
    registered: bool,
) -> tuple[list[Loop], list[Loop]]:
    """The loops of a whole drive that agree and, where they are registered, overlap; and those that do not."""
    kept, refused = _agreeing(loops, odometry, recording.mounting, config)
    if registered:
        kept, others = _registered(recording, kept)
        refused = refused + others
    return kept, refused


def _agreeing(
    loops: list[Loop],
    odometry: Float[np.ndarray, "n 4 4"] | None,
    mounting: Mounting | None,
    config: DetectorConfig,
) -> tuple[list[Loop], list[Loop]]:
    """The largest set of loops that all agree, and the others; without odometry all of them."""
    if odometry is None or len(loops) < 2:
        return loops, []
    pairs = agree(loops, odometry, mounting=mounting, config=config.consistency)
    members = set(largest_consistent_set(pairs).tolist())
    return [loop for i, loop in enumerate(loops) if i in members], [
        loop for i, loop in enumerate(loops) if i not in members
    ]


def _registered(recording: Recording, loops: list[Loop]) -> tuple[list[Loop], list[Loop]]:
    """Loops with poses from full scans, and those whose scans do not overlap."""
    kept, refused = [], []
    for loop in loops:
        found = register(recording.points(loop.query), recording.points(loop.match), initial=loop.match_from_query)
        values = {"match_from_query": found.match_from_query, "covariance": found.covariance, "overlap": found.overlap}
        (kept if found.overlap >= MIN_OVERLAP else refused).append(dataclasses.replace(loop, **values))
    return kept, refused
