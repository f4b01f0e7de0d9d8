"""All loops of a recording: the detector over its scans, then what only the whole drive can tell."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.warning import warn
from sglpr_jax.loops.candidates import Candidate, Seen
from sglpr_jax.loops.consistency import agree, largest_consistent_set
from sglpr_jax.loops.detector import DetectorConfig, LoopDetector
from sglpr_jax.loops.given import check_is, given_poses
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.probability import LoopModel
from sglpr_jax.loops.registration import check_installed, register
from sglpr_jax.loops.unfinished import Unfinished, settings
from sglpr_jax.loops.upright import check_level
from sglpr_jax.models.params import Params
from sglpr_jax.retrieval.embed import OnBadScan

MIN_OVERLAP = 0.6
"""Registered scans that share less of their space show two places. Measured: docs/decisions/loops.md."""
FEWEST_AGAINST = 5
"""Fewer loops than this contradict good odometry now and then."""


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
    skipped: tuple[str, ...] = ()
    """The ids of scans that could not be read."""
    candidates: tuple[Candidate, ...] = ()
    """All pairs that were looked at, loops or not."""
    model: LoopModel | None = None
    """What said how probable they are."""
    unregistered: int = 0
    """So many of the loops were to be registered and are not: none, unless it was stopped."""

    @property
    def whole(self) -> bool:
        """Whether all was done: not where it was stopped."""
        return self.frames == len(self.recording) and not self.unregistered

    def __str__(self) -> str:
        found = f"{len(self.loops)} loops in {self.frames} of {len(self.recording)} frames of {self.recording.name}"
        skipped = f", {len(self.skipped)} scans skipped" if self.skipped else ""
        left = f", {self.unregistered} not registered" if self.unregistered else ""
        return f"{found}, {len(self.refused)} refused afterwards{left}{skipped}"


def find_loops(
    recording: Recording,
    params: Params,
    *,
    odometry: ArrayLike | None = None,
    model: LoopModel | None = None,
    config: DetectorConfig = DetectorConfig(),
    registered: bool = False,
    on_bad_scan: OnBadScan | None = None,
    kept_in: Path | str | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> FoundLoops:
    """Find the loops of a recording.

    With `odometry`, a pose for each scan (LiDAR frame, drifting as it may), candidates too far from it are left out,
    and of the loops found the largest set is kept in which all agree. With `registered` the pose of each loop is made
    one in 6 degrees of freedom from its full scans (extra `slam`), and loops of little overlap are refused. Poses are
    of the LiDAR's own frame, as the points have it, however the sensor is mounted.

    A scan that cannot be read raises its error or, given `on_bad_scan(id, error)`, is left out; frames keep their
    numbers. Scans that show next to nothing have no loops. With `kept_in`, a folder, what was seen of the scans is kept
    there, and a run that was killed goes on from it, if the recording, the odometry, the weights and the settings are
    the same; the folder stays. Ends early, with what was found, when `should_stop` says so: loops that are not
    registered then are in the plane, without an overlap. `on_progress` is told how many scans are done. Warns of
    odometry that most of the loops contradict, as they do in other axes. Raises ValueError for odometry of another
    length or shape and where no scan can be read or shows something, TypeError for what is no recording, no params or
    no array, ImportError without the extra, and what reading the scans raises.

    Example:
      found = find_loops(sglpr_jax.open_recording(root, "08"), sglpr_jax.load("sglpr"))
    """
    check_is(recording, Recording, by="open_recording")
    odometry = None if odometry is None else given_poses(odometry, of="odometry")
    if odometry is not None and len(odometry) != len(recording):
        raise ValueError(
            f"expected odometry of {len(recording)} poses, one for each scan of {recording.name}, found {len(odometry)}"
        )
    if registered and recording.has_images:
        raise ValueError(f"sequence {recording.name}: expected scans to register, found ready-made images")
    if registered:
        check_installed()
    if odometry is not None:
        check_level(odometry, recording.mounting, name=recording.name)
    detector = LoopDetector(params, model=model, config=config)
    given = functools.partial(_given, recording, odometry)
    kept = None
    if kept_in is not None:
        kept = Unfinished.opened(Path(kept_in), settings(recording, detector.finder, odometry=odometry))
        _recall(kept, detector, recording.mounting, given, missing=on_bad_scan is not None)
        if len(detector):
            on_progress(len(detector))
    for i in range(len(detector), len(recording)):
        if should_stop():
            break
        detector.add_seen(detector.finder.seen_scan(recording, i, on_bad_scan), **given(i))
        if kept is not None:
            kept.keep(detector.finder, detector.candidates)
        on_progress(i + 1)
    if kept is not None:
        kept.keep(detector.finder, detector.candidates, all=True)
    skipped = tuple(recording.ids[i] for i in detector.finder.missing)
    if len(skipped) == len(recording):
        raise ValueError(f"sequence {recording.name}: expected at least one readable scan, found none")
    if all(detector.finder.empty) and len(detector) == len(recording):
        raise ValueError(f"{recording.name}: expected scans that show something, found {len(recording)} empty ones")
    loops, refused = settled(
        recording, detector.supported, odometry, config, registered=registered, should_stop=should_stop
    )
    if odometry is not None:
        _check_odometry(recording.name, detector.by_scans, loops, refused)
    left = sum(loop.overlap is None for loop in loops) if registered else 0
    seen = {"skipped": skipped, "candidates": tuple(detector.candidates), "model": detector.model, "unregistered": left}
    return FoundLoops(recording, len(detector), tuple(loops), tuple(refused), odometry, **seen)


def _recall(
    kept: Unfinished,
    detector: LoopDetector,
    mounting: Mounting | None,
    given: Callable[[int], dict[str, Any]],
    *,
    missing: bool,
) -> None:
    """Add what an earlier run has seen to a detector; `given` has time and odometry of a frame."""

    def add(seen: Seen | None, candidates: list[Candidate]) -> None:
        detector.add_seen(seen, **given(len(detector)), candidates=candidates)

    kept.recall(detector.finder, mounting, add, missing=missing)


def _given(recording: Recording, odometry: Float[np.ndarray, "n 4 4"] | None, i: int) -> dict[str, Any]:
    """Time and odometry of a frame."""
    time = None if recording.times is None else float(recording.times[i])
    return {"time": time, "odometry": None if odometry is None else odometry[i]}


def _check_odometry(name: str, by_scans: set[int], loops: list[Loop], refused: list[Loop]) -> None:
    """Warn where most frames that have a loop by the scans alone have none that agrees with the odometry.

    Drift does not do that, other axes do: the loops left are then few, and `refused` has not those that contradict the
    odometry from one frame to the next.
    """
    agreeing = {loop.query for loop in loops} | {loop.query for loop in refused if loop.overlap is not None}
    against = by_scans - agreeing
    if len(against) < FEWEST_AGAINST or 2 * len(against) <= len(by_scans):
        return
    warn(
        f"{name}: expected odometry that most loops agree with, found {len(against)} of {len(by_scans)} loops that are "
        "probable by the scans against it: check the frame and the axes of its file (x forward, y left, z up, of the "
        "LiDAR, not of a camera), and whether its poses are those of these scans"
    )


def settled(
    recording: Recording,
    loops: list[Loop],
    odometry: Float[np.ndarray, "n 4 4"] | None,
    config: DetectorConfig,
    *,
    registered: bool,
    should_stop: Callable[[], bool] = lambda: False,
) -> tuple[list[Loop], list[Loop]]:
    """The loops of a whole drive that agree and, where they are registered, overlap; and those that do not.

    Those that are not registered when `should_stop` says so are taken as they are.
    """
    kept, refused = _agreeing(loops, odometry, recording.mounting, config)
    if registered:
        kept, others = _registered(recording, kept, should_stop)
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


def _registered(
    recording: Recording, loops: list[Loop], should_stop: Callable[[], bool]
) -> tuple[list[Loop], list[Loop]]:
    """Loops with poses from full scans, and those whose scans do not overlap; after a stop the others as they are."""
    kept, refused = [], []
    for i, loop in enumerate(loops):
        if should_stop():
            return [*kept, *loops[i:]], refused
        found = register(
            recording.points(loop.query),
            recording.points(loop.match),
            initial=loop.match_from_query,
            initial_covariance=loop.covariance,
        )
        values = {"match_from_query": found.match_from_query, "covariance": found.covariance, "overlap": found.overlap}
        (kept if found.overlap >= MIN_OVERLAP else refused).append(dataclasses.replace(loop, **values))
    return kept, refused
