"""Search for the loops within and between sessions: a detector over the scans of each one, then joint acceptance.

Loops between two sessions: each stored scan of the later one is compared with the stored scans of the earlier one.
Comparison, probability and sequential test are the same as within a session. Scans of both show other places.
"""

import dataclasses
import functools
import hashlib
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.gravity import with_odometry
from sglpr_jax.data.levelling import Mountings, check_level, mountings_of
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scaled, scaled_poses
from sglpr_jax.data.scan_stream import OnBadScan, check_readable
from sglpr_jax.data.warning import warn
from sglpr_jax.loops.acceptance import AXES, check_odometry, registered_loops, settled
from sglpr_jax.loops.arguments import check_is, given_poses
from sglpr_jax.loops.candidates import CandidateFinder, Compared
from sglpr_jax.loops.checkpoint import add_scans
from sglpr_jax.loops.closure import Loop, Rejected, in_metres, scaled_drift
from sglpr_jax.loops.comparison import Candidate, Comparer, Query
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.consistency import accepted_between
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.frame_alignment import AlignedParts, Part, aligned_frames
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.loops.probability import LoopModel
from sglpr_jax.loops.result import FoundLoops, Session, ordered_rejections
from sglpr_jax.loops.sequence import pair_of, probable_loops, verdict
from sglpr_jax.models.params import Params
from sglpr_jax.odometry.bev_odometry import Motion
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.registration.bev_spectra import query_spectra
from sglpr_jax.registration.gicp import check_installed, is_installed
from sglpr_jax.se3 import inverse


class Input(NamedTuple):
    """Input of a search: a recording, the pose of the LiDAR at each of its scans, and the settings."""

    recording: Recording
    odometry: Float[np.ndarray, "n 4 4"] | None
    config: DetectorConfig

    def scaled(self, scale: Scale) -> "Input":
        """The same input with all lengths multiplied by `scale`. Lengths of the images' settings stay as they are."""
        odometry = None if self.odometry is None else scaled_poses(self.odometry, float(scale))
        keyframe_m, drift = self.config.keyframe_m * scale, scaled_drift(self.config.drift, float(scale))
        config = dataclasses.replace(self.config, keyframe_m=keyframe_m, drift=drift)
        return Input(scaled(self.recording, scale), odometry, config)


class Searched(NamedTuple):
    """A session after the search within it. Lengths are multiplied by the scale of the search."""

    given: Input
    """The drift is that of the odometry, estimated from the drive. None without usable odometry."""
    detector: LoopDetector
    loops: list[Loop]
    rejected: list[Rejected]


def find_loops(
    recordings: Recording | Sequence[Recording],
    params: Params,
    *,
    odometry: ArrayLike | Sequence[ArrayLike | None] | None = None,
    model: LoopModel | None = None,
    config: DetectorConfig = DetectorConfig(),
    registered: bool | None = None,
    scale: Scale = 1,
    on_bad_scan: OnBadScan | None = None,
    kept_in: Path | str | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> FoundLoops:
    """Find the loops of a recording, or those within and between several recordings.

    Poses are between LiDAR frames, the frames of the points, whatever the mounting of the sensor. Scans that are almost
    empty have no loops. A warning says if the odometry contradicts most of the loops.

    Several recordings need no common frame. Loops between two of them are accepted if at least five, over at least 15 m
    of both recordings, fit one transform between the frames and no other transform fits half as many. Otherwise none is
    accepted and there is no transform. Without odometry, the motion estimated from the images is used. Where it is
    unknown, a recording consists of several parts, and each part is aligned by its own loops.

    Arguments:
      recordings: The scans of one recording, or several recordings.
      params: Weights of the model that describes them.
      odometry: Pose of the LiDAR at each scan, with drift (`config.drift`). Candidates and loops beyond the drift are
        rejected. Of the remaining loops the largest consistent set is kept. For a sequence of recordings, a sequence
        with the odometry of each one.
      model: Model of the probabilities, by default the one shipped for the weights.
      config: Settings of the detector.
      registered: Register the full scans of each loop in 6 degrees of freedom. Loops with little overlap
        are rejected. None registers scans, not images.
      scale: Factor for all lengths during the search, 1, 2 or 4, for places that are small in an image, such as rooms.
        Results are in metres. Of the settings, `keyframe_m` and `drift` are in metres, and the other lengths are those
        of the scaled scans.
      on_bad_scan: Called with id and error of a scan that cannot be read. The scan is skipped and the other frames keep
        their numbers. Without it the error is raised.
      kept_in: Checkpoint directory. If recordings, odometry, weights and settings are the same, the search resumes from
        it. The directory is not removed. With several recordings it gets a folder for each one.
      should_stop: If it returns True, the search ends with the loops that were found. Loops that were not registered by
        then have no overlap.
      on_progress: Called with the number of finished steps. A search takes one step for each scan. The comparison of
        two recordings takes one step for each scan of the second one.

    Raises:
      ValueError: If there is no recording, if the odometry has another length or shape, if no scan can be read, or if
        all scans of a recording are empty.
      TypeError: If an argument is not a recording, parameters or an array.
      ImportError: If `registered` is True and small-gicp is not installed.

    Example:
      found = find_loops(sglpr_jax.open_recording(root, "08"), sglpr_jax.load("sglpr"))
    """
    given, registered = _inputs(recordings, odometry, config, registered=registered)
    steps, searches = 0, list[Searched]()
    for number, one in enumerate(given):
        folder = None if kept_in is None else Path(kept_in) / f"{number}" if len(given) > 1 else Path(kept_in)
        found = search_session(
            one.scaled(scale),
            params,
            model=model,
            registered=registered,
            scale=scale,
            on_bad_scan=on_bad_scan,
            kept_in=folder,
            should_stop=should_stop,
            on_progress=lambda done, before=steps: on_progress(before + done),
        )
        searches.append(found)
        steps += len(one.recording)
    loops, rejected, transforms = [], [], []
    for number, one in enumerate(searches):
        own = {"match_session": number, "query_session": number}
        loops += [dataclasses.replace(loop, **own) for loop in one.loops]
        rejected += [dataclasses.replace(other, loop=dataclasses.replace(other.loop, **own)) for other in one.rejected]
    for match, query in itertools.combinations(range(len(given)), 2):
        options = {"registered": registered, "should_stop": should_stop}
        options["on_progress"] = lambda done, before=steps: on_progress(before + done)
        for all_found, some in zip(
            (loops, rejected, transforms), search_pair(match, query, searches, **options), strict=True
        ):
            all_found += some
        steps += len(given[query].recording)
    return FoundLoops(
        tuple(_session(one, found, scale, registered) for one, found in zip(given, searches, strict=True)),
        tuple(in_metres(loop, scale) for loop in loops),
        tuple(dataclasses.replace(one, loop=in_metres(one.loop, scale)) for one in rejected),
        tuple(one.in_metres(scale) for one in transforms),
        model=searches[0].detector.model,
        config=config,
        scale=scale,
        stopped=len(given) > 1 and should_stop(),
    )


def _inputs(
    recordings: Any, odometry: Any, config: DetectorConfig, *, registered: bool | None
) -> tuple[list[Input], bool]:
    """Checked input of each session, and whether loops are registered."""
    several = isinstance(recordings, list | tuple)
    some, poses = (recordings, odometry) if several else ([recordings], [odometry])
    poses = [None] * len(some) if poses is None else list(poses)
    if not some or len(poses) != len(some):
        raise ValueError(f"expected recordings with odometry of each, found {len(some)} with odometry of {len(poses)}")
    for one in some:
        check_is(one, Recording, by="open_recording")
    registered = all(map(can_register, some)) if registered is None else registered
    return [prepared(*pair, config, registered=registered) for pair in zip(some, poses, strict=True)], registered


def _session(given: Input, found: Searched, scale: Scale, registered: bool) -> Session:
    """The searched recording, in metres."""
    finder = found.detector.finder
    return Session(
        given.recording,
        len(finder),
        odometry=None if found.given.odometry is None else given.odometry,
        drift=scaled_drift(found.given.config.drift, 1 / scale),
        skipped=tuple(given.recording.ids[row] for row in finder.missing),
        empty=int(finder.empty.sum()) - len(finder.missing),
        unregistered=sum(loop.overlap is None for loop in found.loops) if registered else 0,
        candidates=tuple(found.detector.candidates),
    )


def search_session(
    given: Input,
    params: Params,
    *,
    model: LoopModel | None = None,
    registered: bool = False,
    scale: Scale = 1,
    on_bad_scan: OnBadScan | None = None,
    kept_in: Path | str | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> Searched:
    """Search one session. The arguments are those of `find_loops`; the input is already checked and scaled."""
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
    finder = detector.finder
    _check_scans(finder, recording)
    if odometry is not None and finder.odometry_check.is_unusable:
        warn(
            f"{recording.name}: the odometry contradicts the motion between neighbouring scans and is ignored; check "
            f"that the poses belong to these scans and use these axes: {AXES}"
        )
        options = {"on_bad_scan": on_bad_scan, "should_stop": should_stop, "on_progress": on_progress}
        given = given._replace(odometry=None)
        return search_session(given, params, model=model, registered=registered, scale=scale, **options)
    if odometry is not None:
        config = dataclasses.replace(config, drift=finder.present_drift)
    options = {"registered": registered, "knows_height": finder.knows_height, "should_stop": should_stop}
    loops, rejected = settled(recording, detector.loops, odometry, config, **options)
    rejected = list(ordered_rejections([*rejected, *detector.rejected, *detector.undecided()]))
    if odometry is not None:
        sensors = mountings_of(recording)
        check_odometry(recording.name, loops, rejected, odometry, config, mounting=sensors, scale=scale)
    return Searched(given._replace(config=config), detector, loops, rejected)


def search_pair(
    match: int,
    query: int,
    searches: Sequence[Searched],
    *,
    registered: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> tuple[list[Loop], list[Rejected], list[AlignedParts]]:
    """Loops, rejected pairs and transforms between two sessions, numbers `match` and `query` of the searched ones."""
    both = searches[match], searches[query]
    finders = both[0].detector.finder, both[1].detector.finder
    levels = [finder.motion.path.level(finder.mountings) for finder in finders]
    motion = Motion.joined([finder.motion for finder in finders], levels)
    mountings = Mountings(finder.mountings[row] for finder in finders for row in range(len(finder)))
    knows_height = all(finder.knows_height for finder in finders)
    model, config = both[0].detector.model, both[0].given.config
    candidates = _candidates_between(*finders, motion, should_stop=should_stop, on_progress=on_progress)
    pairs = [pair_of(one, model, motion, mountings, knows_height=knows_height) for one in candidates]
    rules = {"mounting": mountings, "drift": finders[1].present_drift}
    probable = probable_loops(pairs, model, motion.path, config=config, **rules)
    rejected = [
        Rejected(pair.loop, verdict(pair, model, config.min_probability))
        for pair, loop in zip(pairs, probable, strict=True)
        if loop is None
    ]
    likely = [loop for loop in probable if loop is not None]
    sets, contradicting = accepted_between(likely, motion, **rules)
    offset, ends = len(finders[0]), {"match_session": match, "query_session": query}

    def of_sessions(loop: Loop) -> Loop:
        return dataclasses.replace(loop, query=loop.query - offset, **ends)

    rejected = [Rejected(of_sessions(one.loop), one.reason) for one in [*rejected, *contradicting]]
    loops, transforms = [], []
    for some in sets:
        some = list(map(of_sessions, some))
        if registered:
            recordings = both[1].given.recording, both[0].given.recording
            options = {"knows_height": knows_height, "should_stop": should_stop}
            some, little = registered_loops(*recordings, some, **options)
            rejected += little
        if some:
            transforms.append(_aligned(some, both, motion, rules["drift"]))
            loops += some
    return sorted(loops, key=lambda loop: (loop.query, loop.match)), list(ordered_rejections(rejected)), transforms


def _candidates_between(
    matches: CandidateFinder,
    queries: CandidateFinder,
    motion: Motion,
    *,
    should_stop: Callable[[], bool],
    on_progress: Callable[[int], None],
) -> list[Candidate]:
    """Best match of each stored scan of a session in another one, by their joined motion.

    Raises:
      ValueError: If the images of the two sessions have other sizes.
    """
    found, offset = list[Candidate](), len(matches)
    if not len(queries.stored) or not len(matches.stored):
        return found
    ours, theirs = (finder.stored.image(0).shape for finder in (queries, matches))
    if ours != theirs:
        raise ValueError(f"expected images of one size in both recordings, found {theirs} and {ours} cells")
    joined = np.concatenate([matches.joined, queries.joined + offset])
    comparer = Comparer(motion, queries.present_drift, np.eye(3), matches.config, matches.verification, joined)
    own = queries.stored.shifted(offset)
    for row, frame in enumerate(own.frames.tolist()):
        if should_stop():
            break
        image = own.image(row)
        spectra = query_spectra(image, config=matches.verification)
        query = Query(frame, own.index.descriptors[row], image, spectra)
        fits = comparer.compare(query, matches.stored, own)
        found += comparer.candidates(query, fits, matches.stored.image_of, possible=fits.frames < offset)
        on_progress(row + 1)
    return found


def _aligned(loops: Sequence[Loop], both: Sequence[Searched], motion: Motion, drift: DriftModel) -> AlignedParts:
    """Transform between the parts of two sessions to which some loops belong."""
    first = loops[0]
    ends = (first.match_session, first.match), (first.query_session, first.query)
    parts, poses = [], []
    for (session, frame), one in zip(ends, both, strict=True):
        finder, odometry = one.detector.finder, one.given.odometry
        rows = np.flatnonzero(finder.motion.segments == finder.motion.segments[frame])
        parts.append(Part(session, int(rows[0]), int(rows[-1]), odometry is not None))
        if odometry is None:
            seen = finder.motion.poses @ finder.mountings.uprights(np.arange(len(finder)))
            poses.append(inverse(seen[rows[0]]) @ seen)
        else:
            poses.append(odometry[: len(finder)])
    match_way, query_way = np.split(motion.travelled, [len(poses[0])])
    alignment = aligned_frames(loops, *poses, match_way=match_way, query_way=query_way, drift=drift)
    return AlignedParts(parts[0], parts[1], alignment, len(loops))


def can_register(recording: Recording) -> bool:
    """Whether the scans of a recording can be registered: it has scans, not images, and the extra is installed."""
    return not recording.has_images and is_installed()


def _acceptance(detector: LoopDetector) -> str | None:
    """Hash of all that decides about loops, if the loops decide which scans are stored."""
    if detector.config.max_places is None:
        return None
    return hashlib.sha256(repr((detector.config, detector.model)).encode()).hexdigest()[:16]


def prepared(recording: Recording, odometry: ArrayLike | None, config: DetectorConfig, *, registered: bool) -> Input:
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
    return Input(recording, poses, config)


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
