"""Search for the loops within and between sessions: a detector over the scans of each one, then joint acceptance.

Loops between two sessions: each stored scan of the later one is compared with the stored scans of the earlier one.
Comparison, probability and sequential test are the same as within a session. Scans of both show other places.
"""

import dataclasses
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
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scaled, scaled_poses
from sglpr_jax.data.scan_stream import OnBadScan, check_readable
from sglpr_jax.data.warning import warn
from sglpr_jax.loops.acceptance import AXES, accepted, check_odometry, registered_loops
from sglpr_jax.loops.arguments import check_is, given_poses
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.checkpoint import add_scans
from sglpr_jax.loops.closure import LoopClosure, RejectedClosure, in_metres, scaled_drift, to_lidar, to_upright
from sglpr_jax.loops.comparison import Candidate, Fits, KeyframeComparison, Query
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.consistency import accepted_between
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.frame_alignment import SegmentAlignment, TrajectorySegment, aligned_frames
from sglpr_jax.loops.keyframes import Keyframe
from sglpr_jax.loops.probability import LoopModel
from sglpr_jax.loops.result import LoopSearchResult, Session, ordered_rejections
from sglpr_jax.loops.sequence import pair_of, probable_loops, verdict
from sglpr_jax.models.params import Params
from sglpr_jax.odometry.bev_odometry import BevOdometry
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
    loops: list[LoopClosure]
    rejected: list[RejectedClosure]


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
) -> LoopSearchResult:
    """Find the loops of a recording, or those within and between several recordings.

    Poses are between LiDAR frames, the frames of the points. A warning says if the odometry contradicts most loops.
    Several recordings need no common frame. Loops between two of them are accepted if at least five, over at least 15 m
    of both recordings, fit one transform between the frames and no other transform fits half as many. Without odometry,
    parts whose motion is unknown are aligned one by one.

    Arguments:
      recordings: The scans of one recording, or several recordings.
      params: Weights of the model that describes them.
      odometry: Pose of the LiDAR at each scan, with drift (`config.drift`), for several recordings one array each.
        Candidates and loops beyond the drift are rejected. Of the others the largest consistent set is kept.
      model: Model of the probabilities, by default the one shipped for the weights.
      config: Settings of the detector.
      registered: Register the full scans of each loop in 6 degrees of freedom. Loops with little overlap
        are rejected. None registers scans, not images.
      scale: Factor for all lengths during the search, 1, 2 or 4, for places that are small in an image, such as rooms.
        Results, `config.keyframe_m` and `config.drift` are in metres, the other settings those of scaled scans.
      on_bad_scan: Called with id and error of a scan that cannot be read. The scan is skipped and the other frames keep
        their numbers. Without it the error is raised.
      kept_in: Checkpoint directory, from which a search of the same input resumes. It is not removed. With several
        recordings it gets a folder for each one.
      should_stop: If it returns True, the search ends with the loops that were found. Loops that were not registered by
        then have no overlap.
      on_progress: Called with the number of finished steps: one for each scan of a search, and one for each scan of the
        second recording in the comparison of two.

    Raises:
      ValueError: If there is no recording, if the odometry has another length or shape, if no scan can be read, or if
        all scans of a recording are empty.
      TypeError: If an argument is not a recording, parameters or an array.
      ImportError: If `registered` is True and small-gicp is not installed.

    Example:
      found = find_loops(sglpr_jax.open_recording(root, "08"), sglpr_jax.load("sglpr"))
    """
    several = isinstance(recordings, list | tuple)
    some: Any = recordings if several else [recordings]
    poses: Any = odometry if several else [odometry]
    poses = [None] * len(some) if poses is None else list(poses)
    if not some or len(poses) != len(some):
        raise ValueError(f"expected recordings with odometry of each, found {len(some)} with odometry of {len(poses)}")
    for one in some:
        check_is(one, Recording, by="open_recording")
    registered = all(map(can_register, some)) if registered is None else registered
    given = [_checked(*pair, config, registered=registered) for pair in zip(some, poses, strict=True)]
    options = {"registered": registered, "should_stop": should_stop}
    steps, searches = 0, list[Searched]()
    loops, rejected, transforms = [], [], []
    for number, one in enumerate(given):
        folder = None if kept_in is None else Path(kept_in) / f"{number}" if len(given) > 1 else Path(kept_in)
        large = one.scaled(scale)
        found = _search_session(
            large,
            LoopDetector(params, model=model, config=large.config),
            scale=scale,
            on_bad_scan=on_bad_scan,
            kept_in=folder,
            on_progress=lambda done, before=steps: on_progress(before + done),
            **options,
        )
        searches.append(found)
        own = {"match_session": number, "query_session": number}
        loops += [dataclasses.replace(loop, **own) for loop in found.loops]
        rejected += [RejectedClosure(dataclasses.replace(other.loop, **own), other.reason) for other in found.rejected]
        steps += len(one.recording)
    for match, query in itertools.combinations(range(len(given)), 2):
        pair = _search_pair(
            match, query, searches, on_progress=lambda done, before=steps: on_progress(before + done), **options
        )
        for all_found, new in zip((loops, rejected, transforms), pair, strict=True):
            all_found += new
        steps += len(given[query].recording)
    return LoopSearchResult(
        tuple(_session(one, found, scale, registered) for one, found in zip(given, searches, strict=True)),
        tuple(in_metres(loop, scale) for loop in loops),
        tuple(RejectedClosure(in_metres(one.loop, scale), one.reason) for one in rejected),
        tuple(one.in_metres(scale) for one in transforms),
        model=searches[0].detector.model,
        config=config,
        scale=scale,
        stopped=len(given) > 1 and should_stop(),
    )


def can_register(recording: Recording) -> bool:
    """Whether the scans of a recording can be registered: it has scans, not images, and the extra is installed."""
    return not recording.has_images and is_installed()


def _checked(recording: Recording, odometry: ArrayLike | None, config: DetectorConfig, *, registered: bool) -> Input:
    """Check recording and odometry before any work. Returns the odometry as an array, and gravity of scans by it."""
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
        recording = with_odometry(recording, poses)
    return Input(recording, poses, config)


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


def _search_session(
    given: Input,
    detector: LoopDetector,
    *,
    registered: bool,
    scale: Scale,
    on_bad_scan: OnBadScan | None,
    kept_in: Path | None,
    should_stop: Callable[[], bool],
    on_progress: Callable[[int], None],
) -> Searched:
    """Search one session with a detector without frames. The input is already checked and scaled."""
    (recording, odometry, config), finder = given, detector.finder
    stream = {"on_bad_scan": on_bad_scan, "should_stop": should_stop, "on_progress": on_progress}

    def add(keyframe: Keyframe | None, compared: Fits | None) -> None:
        row = len(detector)
        time = None if recording.times is None else float(recording.times[row])
        detector.add_keyframe(
            keyframe, time=time, odometry=None if odometry is None else odometry[row], compared=compared
        )

    # With a limit of places, the loops decide which scans are stored, and so does all that decides about loops.
    decisive = None if config.max_places is None else repr((config, detector.model)).encode()
    add_scans(
        recording,
        finder,
        add,
        kept_in=kept_in,
        odometry=odometry,
        keyframe_m=config.keyframe_m,
        max_places=config.max_places,
        acceptance=None if decisive is None else hashlib.sha256(decisive).hexdigest()[:16],
        **stream,
    )
    check_readable(recording, len(recording) - len(finder.missing))
    if finder.empty.all() and len(finder) == len(recording):
        raise ValueError(
            f"{recording.name}: expected at least one scan that is not empty, found {len(recording)} empty ones"
        )
    if odometry is not None and finder.odometry_check.is_unusable:
        warn(
            f"{recording.name}: the odometry contradicts the motion between neighbouring scans and is ignored; check "
            f"that the poses belong to these scans and use these axes: {AXES}"
        )
        again = LoopDetector(finder.params, model=detector.model, config=config)
        options = {"registered": registered, "scale": scale, "kept_in": None, **stream}
        return _search_session(given._replace(odometry=None), again, **options)
    loops, rejected, path = detector.loops, list[RejectedClosure](), finder.motion.path
    if odometry is not None:
        config = dataclasses.replace(config, drift=finder.present_drift)
        kept, others = accepted([_moved(to_upright, loop, finder) for loop in loops], path, drift=config.drift)
        loops = [_moved(to_lidar, loop, finder) for loop in kept]
        rejected = [RejectedClosure(_moved(to_lidar, one.loop, finder), one.reason) for one in others]
    if registered:
        options = {"knows_height": finder.knows_height, "should_stop": should_stop}
        loops, others = registered_loops(recording, recording, loops, **options)
        rejected += others
    rejected = ordered_rejections([*rejected, *detector.rejected, *detector.undecided()])
    if odometry is not None:
        against = [_moved(to_upright, one.loop, finder) for one in rejected if one.reason == "contradicts the odometry"]
        check_odometry(recording.name, loops, against, path, config, scale)
    return Searched(given._replace(config=config), detector, loops, rejected)


def _moved(to_frames: Callable[..., LoopClosure], loop: LoopClosure, finder: CandidateSearch) -> LoopClosure:
    """A loop within a session between the gravity-aligned frames (`to_upright`) or the LiDAR frames (`to_lidar`)."""
    return to_frames(loop, query=finder.mountings[loop.query], match=finder.mountings[loop.match])


def _search_pair(
    match: int,
    query: int,
    searches: Sequence[Searched],
    *,
    registered: bool,
    should_stop: Callable[[], bool],
    on_progress: Callable[[int], None],
) -> tuple[list[LoopClosure], list[RejectedClosure], list[SegmentAlignment]]:
    """Loops, rejected pairs and transforms between two sessions, numbers `match` and `query` of the searched ones."""
    both = searches[match], searches[query]
    finders = both[0].detector.finder, both[1].detector.finder
    motion = BevOdometry.joined([finder.motion for finder in finders])
    mountings = [*finders[0].mountings, *finders[1].mountings]
    knows_height = all(finder.knows_height for finder in finders)
    model, config, drift = both[0].detector.model, both[0].given.config, finders[1].present_drift
    candidates = _candidates_between(*finders, motion, should_stop=should_stop, on_progress=on_progress)
    pairs = [pair_of(one, model, motion, mountings, knows_height=knows_height) for one in candidates]
    probable = probable_loops(pairs, model, motion.path, drift=drift, config=config)
    improbable = [
        RejectedClosure(pair.loop, verdict(pair, model, config.min_probability))
        for pair, loop in zip(pairs, probable, strict=True)
        if loop is None
    ]
    likely = [loop for loop in probable if loop is not None]
    sets, contradicting = accepted_between(likely, motion, drift=drift)
    offset, ends = len(finders[0]), {"match_session": match, "query_session": query}

    def of_sessions(loop: LoopClosure) -> LoopClosure:
        loop = to_lidar(loop, query=mountings[loop.query], match=mountings[loop.match])
        return dataclasses.replace(loop, query=loop.query - offset, **ends)

    rejected = [RejectedClosure(of_sessions(one.loop), one.reason) for one in [*improbable, *contradicting]]
    loops, transforms = [], []
    for some in sets:
        some = list(map(of_sessions, some))
        if registered:
            recordings = both[1].given.recording, both[0].given.recording
            options = {"knows_height": knows_height, "should_stop": should_stop}
            some, little = registered_loops(*recordings, some, **options)
            rejected += little
        if some:
            transforms.append(_aligned(some, both, motion, drift))
            loops += some
    return sorted(loops, key=lambda loop: (loop.query, loop.match)), ordered_rejections(rejected), transforms


def _candidates_between(
    matches: CandidateSearch,
    queries: CandidateSearch,
    motion: BevOdometry,
    *,
    should_stop: Callable[[], bool],
    on_progress: Callable[[int], None],
) -> list[Candidate]:
    """Best match of each stored scan of a session in another one, by their joined motion.

    Raises ValueError if the images of the two sessions have other sizes.
    """
    found, offset = list[Candidate](), len(matches)
    if not len(queries.stored) or not len(matches.stored):
        return found
    ours, theirs = (finder.stored.image(0).shape for finder in (queries, matches))
    if ours != theirs:
        raise ValueError(f"expected images of one size in both recordings, found {theirs} and {ours} cells")
    joined = np.concatenate([matches.joined.rows, queries.joined.rows + offset])
    comparer = KeyframeComparison(motion, queries.present_drift, matches.config, matches.verification, joined)
    own = queries.stored.shifted(offset)
    for row, frame in enumerate(own.frames.tolist()):
        if should_stop():
            break
        image = own.image(row)
        spectra = query_spectra(image, config=matches.verification)
        query = Query(frame, own.index.descriptors[row], image, spectra)
        fits = comparer.compare(query, matches.stored, own)
        found += comparer.candidates(query, fits, matches.stored, possible=fits.frames < offset)
        on_progress(row + 1)
    return found


def _aligned(
    loops: Sequence[LoopClosure], both: Sequence[Searched], motion: BevOdometry, drift: DriftModel
) -> SegmentAlignment:
    """Transform between the parts of two sessions to which some loops belong."""
    first = loops[0]
    ends = (first.match_session, first.match), (first.query_session, first.query)
    parts, poses = [], []
    for (session, frame), one in zip(ends, both, strict=True):
        finder, odometry = one.detector.finder, one.given.odometry
        rows = np.flatnonzero(finder.motion.segments == finder.motion.segments[frame])
        parts.append(TrajectorySegment(session, int(rows[0]), int(rows[-1]), odometry is not None))
        if odometry is None:
            keyframe = finder.motion.poses @ one.given.recording.uprights[: len(finder)]
            poses.append(inverse(keyframe[rows[0]]) @ keyframe)
        else:
            poses.append(odometry[: len(finder)])
    match_way, query_way = np.split(motion.travelled, [len(poses[0])])
    found = aligned_frames(loops, *poses, match_way=match_way, query_way=query_way, drift=drift)
    return SegmentAlignment(parts[0], parts[1], *found, len(loops))
