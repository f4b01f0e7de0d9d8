"""Search for the loops of a recording: detector over all scans, then joint acceptance over the whole drive."""

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.gravity import with_odometry
from sglpr_jax.data.levelling import check_level, mountings_of
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import OnBadScan, check_readable
from sglpr_jax.data.warning import warn
from sglpr_jax.loops.acceptance import AXES, check_odometry, settled
from sglpr_jax.loops.arguments import check_is, given_poses
from sglpr_jax.loops.candidates import CandidateFinder, Compared
from sglpr_jax.loops.checkpoint import add_scans
from sglpr_jax.loops.closure import (
    MEANING,
    Loop,
    Rejected,
    Search,
    counted,
    divided_loop,
    divided_rejected,
    listed,
    scaled_drift,
)
from sglpr_jax.loops.comparison import Candidate
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.loops.probability import LoopModel
from sglpr_jax.models.params import Params
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.registration.gicp import check_installed, is_installed


@dataclasses.dataclass(frozen=True, eq=False)
class FoundLoops:
    """Loops of a recording, with the trajectory and the settings of the search."""

    recording: Recording
    frames: int
    """Number of scans that were searched: all, unless the search was stopped."""
    loops: tuple[Loop, ...]
    rejected: tuple[Rejected, ...]
    """All other compared pairs, each with the reason for its rejection."""
    odometry: Float[np.ndarray, "n 4 4"] | None
    """Pose of the LiDAR at every scan of the recording."""
    skipped: tuple[str, ...] = ()
    """Ids of scans that cannot be read."""
    candidates: tuple[Candidate, ...] = ()
    """All compared pairs or, with `max_places`, that many of the last ones."""
    model: LoopModel | None = None
    """Model of the probabilities."""
    unregistered: int = 0
    """Number of loops that were not registered because the search was stopped."""
    config: DetectorConfig = DetectorConfig()
    """Settings of the search. The drift is that of the odometry, estimated from the drive."""
    empty: int = 0
    """Number of searched scans that are almost empty."""
    scale: Scale = 1
    """Factor for all lengths during the search. Loops, odometry and settings are in metres; candidates are scaled."""

    @property
    def drift(self) -> DriftModel:
        """Drift model of the odometry."""
        return self.config.drift

    @property
    def whole(self) -> bool:
        """Whether the search was completed."""
        return self.frames == len(self.recording) and not self.unregistered

    def __str__(self) -> str:
        degenerate = sum(loop.is_degenerate for loop in self.loops)
        loops = f"{len(self.loops)} loops{f' ({degenerate} degenerate)' if degenerate else ''}"
        found = f"{loops} in {self.frames} of {len(self.recording)} frames of {self.recording.name}"
        why = f" ({listed(counted(self.rejected))})" if self.rejected else ""
        skipped = f", {len(self.skipped)} scans skipped" if self.skipped else ""
        left = f", {self.unregistered} not registered" if self.unregistered else ""
        scale = f", scale {self.scale}" if self.scale != 1 else ""
        return f"{found}, {len(self.rejected)} rejected{why}{left}{skipped}{scale}"

    def divided(self, given: Search, scale: Scale) -> "FoundLoops":
        """Results in metres of a search whose input `given` was multiplied by `scale`."""
        drift = scaled_drift(self.config.drift, 1 / scale)
        return dataclasses.replace(
            self,
            recording=given.recording,
            odometry=None if self.odometry is None else given.odometry,
            config=dataclasses.replace(given.config, drift=drift),
            loops=tuple(divided_loop(loop, scale) for loop in self.loops),
            rejected=tuple(divided_rejected(one, scale) for one in self.rejected),
            scale=scale,
        )

    def without_degenerate(self) -> "FoundLoops":
        """Reject the loops whose position is uncertain by more than 1 m in some horizontal direction
        (`is_degenerate`).
        """
        kept = tuple(loop for loop in self.loops if not loop.is_degenerate)
        others = [Rejected(loop, "degenerate") for loop in self.loops if loop.is_degenerate]
        return dataclasses.replace(self, loops=kept, rejected=_in_order([*self.rejected, *others]))


def find_loops(
    recording: Recording,
    params: Params,
    *,
    odometry: ArrayLike | None = None,
    model: LoopModel | None = None,
    config: DetectorConfig = DetectorConfig(),
    registered: bool | None = None,
    scale: Scale = 1,
    on_bad_scan: OnBadScan | None = None,
    kept_in: Path | str | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> FoundLoops:
    """Find the loops of a recording.

    Poses are between LiDAR frames, the frames of the points, whatever the mounting of the sensor. Scans that are almost
    empty have no loops. A warning says if the odometry contradicts most of the loops.

    Arguments:
      recording: The scans.
      params: Weights of the model that describes them.
      odometry: Pose of the LiDAR at each scan, with drift (`config.drift`). Candidates and loops beyond the drift are
        rejected. Of the remaining loops the largest consistent set is kept.
      model: Model of the probabilities, by default the one shipped for the weights.
      config: Settings of the detector.
      registered: Register the full scans of each loop in 6 degrees of freedom. Loops with little overlap
        are rejected. None registers scans, not images.
      scale: Factor for all lengths during the search, 1, 2 or 4, for places that are small in an image, such as rooms.
        Results are in metres. Of the settings, `keyframe_m` and `drift` are in metres, and the other lengths are those
        of the scaled scans.
      on_bad_scan: Called with id and error of a scan that cannot be read. The scan is skipped and the other frames keep
        their numbers. Without it the error is raised.
      kept_in: Checkpoint directory. If recording, odometry, weights and settings are the same, the search resumes from
        it. The directory is not removed.
      should_stop: If it returns True, the search ends with the loops that were found. Loops that were not registered by
        then have no overlap.
      on_progress: Called with the number of searched scans.

    Raises:
      ValueError: If the odometry has another length or shape, if no scan can be read, or if all scans are empty.
      TypeError: If an argument is not a recording, parameters or an array.
      ImportError: If `registered` is True and small-gicp is not installed.

    Example:
      found = find_loops(sglpr_jax.open_recording(root, "08"), sglpr_jax.load("sglpr"))
    """
    check_is(recording, Recording, by="open_recording")
    registered = can_register(recording) if registered is None else registered
    given = prepared(recording, odometry, config, registered=registered)
    found, _ = searched(
        given.scaled(scale),
        params,
        model=model,
        registered=registered,
        scale=scale,
        on_bad_scan=on_bad_scan,
        kept_in=kept_in,
        should_stop=should_stop,
        on_progress=on_progress,
    )
    return found.divided(given, scale)


def searched(
    given: Search,
    params: Params,
    *,
    model: LoopModel | None,
    registered: bool,
    scale: Scale,
    on_bad_scan: OnBadScan | None,
    kept_in: Path | str | None,
    should_stop: Callable[[], bool],
    on_progress: Callable[[int], None],
) -> tuple[FoundLoops, CandidateFinder]:
    """Do the same as `find_loops` with checked and scaled arguments, and also return the finder with images and motion.

    The results are scaled, too.
    """
    recording, odometry, config = given
    detector = LoopDetector(params, model=model, config=config)
    add_scans(
        recording,
        detector.finder,
        functools.partial(_add, detector, recording, odometry),
        kept_in=kept_in,
        on_bad_scan=on_bad_scan,
        should_stop=should_stop,
        on_progress=on_progress,
        odometry=odometry,
        keyframe_m=config.keyframe_m,
        max_places=config.max_places,
        acceptance=_acceptance(detector),
    )
    _check_scans(detector.finder, recording)
    if odometry is not None and detector.finder.odometry_check.is_unusable:
        warn(
            f"{recording.name}: the odometry contradicts the motion between neighbouring scans and is ignored; check "
            f"that the poses belong to these scans and use these axes: {AXES}"
        )
        return searched(
            given._replace(odometry=None),
            params,
            model=model,
            registered=registered,
            scale=scale,
            on_bad_scan=on_bad_scan,
            kept_in=None,
            should_stop=should_stop,
            on_progress=on_progress,
        )
    if odometry is not None:
        config = dataclasses.replace(config, drift=detector.finder.present_drift)
    options = {"registered": registered, "scale": scale, "should_stop": should_stop}
    loops, rejected = _accepted(detector, recording, odometry, config, **options)
    missing = detector.finder.missing
    found = FoundLoops(
        recording,
        len(detector),
        loops,
        rejected,
        odometry,
        skipped=tuple(recording.ids[i] for i in missing),
        candidates=tuple(detector.candidates),
        model=detector.model,
        unregistered=sum(loop.overlap is None for loop in loops) if registered else 0,
        config=config,
        empty=int(detector.finder.empty.sum()) - len(missing),
    )
    return found, detector.finder


def can_register(recording: Recording) -> bool:
    """Whether the scans of a recording can be registered: it has scans, not images, and the extra is installed."""
    return not recording.has_images and is_installed()


def _acceptance(detector: LoopDetector) -> str | None:
    """Hash of all that decides about loops, if the loops decide which scans are stored."""
    if detector.config.max_places is None:
        return None
    return hashlib.sha256(repr((detector.config, detector.model)).encode()).hexdigest()[:16]


def prepared(recording: Recording, odometry: ArrayLike | None, config: DetectorConfig, *, registered: bool) -> Search:
    """Check recording and odometry before any work. Return the odometry as an array, and gravity of scans by it."""
    poses = None if odometry is None else given_poses(odometry, of="odometry")
    if poses is not None and len(poses) != len(recording):
        raise ValueError(
            f"expected odometry of {len(recording)} poses, one for each scan of {recording.name}, found {len(poses)}"
        )
    if registered and recording.has_images:
        raise ValueError(f"sequence {recording.name}: expected scans to register, found ready-made images")
    if registered:
        check_installed()
    if poses is not None:
        check_level(poses, mountings_of(recording), name=recording.name)
        recording = with_odometry(recording, poses)
    return Search(recording, poses, config)


def _add(
    detector: LoopDetector,
    recording: Recording,
    odometry: Float[np.ndarray, "n 4 4"] | None,
    seen: Seen | None,
    compared: Compared | None,
) -> None:
    """Add the next frame to the detector, with its time and odometry."""
    i = len(detector)
    time = None if recording.times is None else float(recording.times[i])
    detector.add_seen(seen, time=time, odometry=None if odometry is None else odometry[i], compared=compared)


def _check_scans(finder: CandidateFinder, recording: Recording) -> None:
    """Raise ValueError if all scans of a recording are unreadable or almost empty."""
    check_readable(recording, len(recording) - len(finder.missing))
    if finder.empty.all() and len(finder) == len(recording):
        raise ValueError(
            f"{recording.name}: expected at least one scan that is not empty, found {len(recording)} empty ones"
        )


def _accepted(
    detector: LoopDetector,
    recording: Recording,
    odometry: Float[np.ndarray, "n 4 4"] | None,
    config: DetectorConfig,
    *,
    registered: bool,
    scale: Scale,
    should_stop: Callable[[], bool],
) -> tuple[tuple[Loop, ...], tuple[Rejected, ...]]:
    """Joint acceptance of the loops of a detector. Returns accepted and rejected loops, and warns of wrong odometry."""
    options = {"registered": registered, "knows_height": detector.finder.knows_height, "should_stop": should_stop}
    loops, rejected = settled(recording, detector.loops, odometry, config, **options)
    rejected = _in_order([*rejected, *detector.rejected, *detector.undecided()])
    if odometry is not None:
        name, mounting = recording.name, mountings_of(recording)
        check_odometry(name, loops, rejected, odometry, config, mounting=mounting, scale=scale)
    return tuple(loops), rejected


def _in_order(rejected: Iterable[Rejected]) -> tuple[Rejected, ...]:
    return tuple(sorted(rejected, key=lambda one: (one.loop.query, one.loop.match)))


def why_none(found: FoundLoops) -> list[str]:
    """Reasons why a recording has no loops, one sentence each. Empty if there are loops."""
    if found.loops:
        return []
    if not found.frames:
        return ["The search was stopped before the first scan."]
    reasons = []
    if found.frames < len(found.recording):
        reasons.append(f"The search was stopped after {found.frames} of {len(found.recording)} frames.")
    if 2 * found.empty > found.frames:
        cells = found.config.candidates.min_cells
        reasons.append(
            f"{found.empty} of {found.frames} scans are almost empty (fewer than {cells} occupied cells of the image): "
            "check the format and the range of the points, and whether the sensor was covered."
        )
    if 2 * len(found.skipped) > found.frames:
        reasons.append(f"{len(found.skipped)} of {found.frames} scans cannot be read.")
    return [*reasons, _of_pairs(found)]


def _of_pairs(found: FoundLoops) -> str:
    """Most frequent reason why the compared pairs are not loops."""
    if not found.rejected:
        source = "images" if found.odometry is None else "odometry"
        return (
            f"No pair was compared: according to the {source}, no scan came back to a place after at least "
            f"{found.config.candidates.recent_m:g} m of travelled distance."
        )
    reason, count = next(iter(counted(found.rejected).items()))
    return f"{len(found.rejected)} pairs were compared. For {count} of them: {MEANING[reason]}"
