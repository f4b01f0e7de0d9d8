"""Search for the loops within and between sessions: a detector over the scans of each one, then joint acceptance.

Only keyframes are read and searched. For loops between two sessions, each stored scan of the later session is compared
with the stored scans of the earlier one. Probability and sequential test are the same as within a session. Scans of
both sessions are distractors.
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
from sglpr_jax.data.poses import as_scan_poses
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scaled, scaled_poses
from sglpr_jax.data.scan_stream import OnBadScan, check_readable
from sglpr_jax.fields import check_is
from sglpr_jax.files import warn
from sglpr_jax.loops.acceptance import AXES, accept_loops, check_odometry, register_loops
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.checkpoint import add_scans
from sglpr_jax.loops.closure import LoopClosure, RejectedClosure, convert_rejected, in_metres, renumbered, to_lidar
from sglpr_jax.loops.comparison import Candidate, Fits, KeyframeComparison, Query
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.consistency import accept_between
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.frame_alignment import SegmentAlignment, TrajectorySegment, align_frames
from sglpr_jax.loops.keyframes import Keyframe
from sglpr_jax.loops.probability import LoopModel
from sglpr_jax.loops.result import LoopSearchResult, Session, ordered_rejections
from sglpr_jax.loops.sequence import pair_of, probable_loops, rejection_reason
from sglpr_jax.models.weights import Params
from sglpr_jax.odometry.bev_odometry import BevOdometry
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.se3 import inverse


class SearchedSession(NamedTuple):
    """A session after the search within it. Lengths are multiplied by the scale of the search."""

    recording: Recording
    odometry: Float[np.ndarray, "n 4 4"] | None
    """Pose of the LiDAR at each scan. None without usable odometry."""
    drift: DriftModel
    """Drift of the odometry, estimated from the drive."""
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
    of both recordings, fit one transform between the frames, and if no other transform fits more than half as many.
    Without odometry, each pair of segments, between which the motion is unknown, is aligned on its own.

    Arguments:
      recordings: The scans of one recording, or several recordings.
      params: Weights of the model that describes them.
      odometry: Pose of the LiDAR at each scan, with drift (`config.drift`), for several recordings one array each.
        Candidates and loops beyond the drift are rejected. Of the others the largest consistent set is kept.
      model: Model of the probabilities, by default the shipped one.
      config: Settings of the detector.
      registered: Register the full scans of each loop in 6 degrees of freedom. Loops with little overlap are rejected.
        None does so if all recordings have scans, not images.
      scale: Factor for all lengths during the search, 1, 2 or 4, for places that are small in an image, such as rooms.
        Results and `config.drift` are in metres, the other settings those of scaled scans.
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

    Example:
      found = find_loops(sglpr_jax.open_recording(root, "08"), sglpr_jax.load("sglpr"))
    """
    has_several = isinstance(recordings, list | tuple)
    all_recordings: Any = recordings if has_several else [recordings]
    all_odometry: Any = odometry if has_several else [odometry]
    all_odometry = [None] * len(all_recordings) if all_odometry is None else list(all_odometry)
    if not all_recordings or len(all_odometry) != len(all_recordings):
        counts = f"{len(all_recordings)} with odometry of {len(all_odometry)}"
        raise ValueError(f"expected recordings with odometry of each, found {counts}")
    for recording in all_recordings:
        check_is(recording, Recording, by="open_recording")
    registered = not any(one.has_images for one in all_recordings) if registered is None else registered
    inputs = list[tuple[Recording, Float[np.ndarray, "n 4 4"] | None]]()
    for recording, given in zip(all_recordings, all_odometry, strict=True):
        poses = None if given is None else as_scan_poses(given, recording, of="odometry")
        if registered:
            recording.require_scans("scans to register")
        # With odometry, scans of a sensor that tilts are levelled.
        inputs.append((recording if poses is None else with_odometry(recording, poses), poses))
    finished_steps, searched = 0, list[SearchedSession]()
    loops, rejected, transforms = list[LoopClosure](), list[RejectedClosure](), list[SegmentAlignment]()

    def report(done: int) -> None:
        on_progress(finished_steps + done)

    options = {"registered": registered, "should_stop": should_stop, "on_progress": report}
    for number, (recording, poses) in enumerate(inputs):
        session = _search_session(
            scaled(recording, scale),
            None if poses is None else scaled_poses(poses, float(scale)),
            LoopDetector(params, model=model, config=config.at_scale(float(scale))),
            scale=scale,
            on_bad_scan=on_bad_scan,
            kept_in=None if kept_in is None else Path(kept_in) / (f"{number}" if len(inputs) > 1 else ""),
            **options,
        )
        searched.append(session)

        def in_session(loop: LoopClosure, number: int = number) -> LoopClosure:
            return dataclasses.replace(loop, match_session=number, query_session=number)

        loops += map(in_session, session.loops)
        rejected += convert_rejected(session.rejected, in_session)
        finished_steps += len(recording)
    for match, query in itertools.combinations(range(len(inputs)), 2):
        pair_loops, pair_rejected, pair_transforms = _search_pair(match, query, searched, **options)
        loops += pair_loops
        rejected += pair_rejected
        transforms += pair_transforms
        finished_steps += len(searched[query].recording)
    sessions = (
        _session_in_metres(recording, poses, session, scale, registered)
        for (recording, poses), session in zip(inputs, searched, strict=True)
    )
    return LoopSearchResult(
        tuple(sessions),
        tuple(in_metres(loop, scale) for loop in loops),
        tuple(convert_rejected(rejected, lambda loop: in_metres(loop, scale))),
        tuple(transform.in_metres(scale) for transform in transforms),
        model=searched[0].detector.model,
        config=config,
        scale=scale,
        stopped=len(inputs) > 1 and should_stop(),
    )


def _session_in_metres(
    recording: Recording,
    odometry: Float[np.ndarray, "n 4 4"] | None,
    searched: SearchedSession,
    scale: Scale,
    registered: bool,
) -> Session:
    """Result of a session, from recording and odometry in metres, and from a search with lengths times `scale`."""
    finder = searched.detector.finder
    return Session(
        recording,
        finder.scans,
        keyframes=len(finder),
        odometry=None if searched.odometry is None else odometry,
        drift=searched.drift.at_scale(1 / scale),
        skipped=tuple(recording.ids[row] for row in finder.rows[finder.missing]),
        empty=int(finder.empty.sum()) - len(finder.missing),
        unregistered=sum(loop.overlap is None for loop in searched.loops) if registered else 0,
        candidates=tuple(searched.detector.candidates),
    )


def _search_session(
    recording: Recording,
    odometry: Float[np.ndarray, "n 4 4"] | None,
    detector: LoopDetector,
    *,
    registered: bool,
    scale: Scale,
    on_bad_scan: OnBadScan | None,
    kept_in: Path | None,
    should_stop: Callable[[], bool],
    on_progress: Callable[[int], None],
) -> SearchedSession:
    """Search one session with a detector without frames. Recording and odometry are already checked and scaled.

    Odometry that the images contradict is ignored: after the last scan, the session is searched again without odometry.
    """
    config, finder = detector.config, detector.finder
    stream = {"on_bad_scan": on_bad_scan, "should_stop": should_stop, "on_progress": on_progress}

    def at(row: int) -> dict[str, Any]:
        """Time and odometry of a scan."""
        time = None if recording.times is None else float(recording.times[row])
        return {"time": time, "odometry": None if odometry is None else odometry[row]}

    def add(keyframe: Keyframe | None, fits: Fits | None) -> None:
        detector.add_keyframe(keyframe, fits=fits, **at(finder.scans))

    # With a limit of places, loops decide which scans are stored. A checkpoint then depends on settings and model, too.
    acceptance = None
    if config.max_places is not None:
        acceptance = hashlib.sha256(repr((config, detector.model)).encode()).hexdigest()[:16]
    add_scans(
        recording,
        finder,
        add,
        is_due=lambda row: finder.is_due(**at(row)),
        kept_in=kept_in,
        odometry=odometry,
        keyframe_m=config.keyframe_m,
        max_places=config.max_places,
        acceptance=acceptance,
        **stream,
    )
    if finder.scans > (finder.rows[-1] + 1 if len(finder) else 0):
        on_progress(finder.scans)  # with the scans after the last keyframe
    if finder.scans == len(recording):
        check_readable(recording, len(finder) - len(finder.missing))
        if finder.empty.all():
            raise ValueError(
                f"{recording.name}: expected at least one scan that is not empty, found {len(finder)} empty ones"
            )
    if odometry is not None and finder.odometry_check.is_unusable:
        is_complete = finder.scans == len(recording)
        fate = "is ignored" if is_complete else "will be ignored after the last scan"
        length, degrees = finder.odometry_check.errors  # per metre of the scaled drive
        warn(
            f"{recording.name}: the odometry contradicts the motion between neighbouring scans and {fate}: it "
            f"differs by {100 * length:.0f} % of the travelled distance and {100 * scale * degrees:.0f} degrees per "
            f"100 m; check that the poses belong to these scans and use these axes: {AXES}"
        )
        if is_complete:
            new_detector = LoopDetector(finder.params, model=detector.model, config=config)
            options = {"registered": registered, "scale": scale, **stream}
            kept_in = None if kept_in is None else kept_in / "without-odometry"
            return _search_session(recording, None, new_detector, kept_in=kept_in, **options)
    loops, rejected = detector.loops, list[RejectedClosure]()
    drift = config.drift if odometry is None else finder.present_drift
    path = finder.motion.path
    if odometry is not None:
        upright_loops, contradicting = accept_loops(list(map(finder.to_upright, loops)), path, drift=drift)
        loops, rejected = list(map(finder.to_lidar, upright_loops)), convert_rejected(contradicting, finder.to_lidar)
    if registered:
        options = {"knows_height": finder.knows_height, "should_stop": should_stop}
        loops, without_overlap = register_loops(recording, recording, loops, **options)
        rejected += without_overlap
    rejected = ordered_rejections([*rejected, *detector.rejected, *detector.undecided()])
    if odometry is not None:
        against = [finder.to_upright(each.loop) for each in rejected if each.reason == "contradicts the odometry"]
        check_odometry(recording.name, list(map(finder.to_upright, loops)), against, path, drift, scale)
    return SearchedSession(recording, odometry, drift, detector, loops, rejected)


def _search_pair(
    match: int,
    query: int,
    searched: Sequence[SearchedSession],
    *,
    registered: bool,
    should_stop: Callable[[], bool],
    on_progress: Callable[[int], None],
) -> tuple[list[LoopClosure], list[RejectedClosure], list[SegmentAlignment]]:
    """Loops, rejected pairs and transforms between two of the searched sessions, given by their numbers.

    Frames of the queries are counted from the end of the matches' session, until `between_sessions` converts them to
    numbers of scans.
    """
    sessions = searched[match], searched[query]
    match_finder, query_finder = (session.detector.finder for session in sessions)
    motion = BevOdometry.joined([match_finder.motion, query_finder.motion])
    mountings = [*match_finder.mountings, *query_finder.mountings]
    knows_height = match_finder.knows_height and query_finder.knows_height
    model, config = sessions[0].detector.model, sessions[0].detector.config
    drift = DriftModel.largest(match_finder.present_drift, query_finder.present_drift)
    options = {"should_stop": should_stop, "on_progress": on_progress}
    candidates = _candidates_between(match_finder, query_finder, motion, drift, **options)
    pairs = [pair_of(candidate, model, motion, mountings, knows_height=knows_height) for candidate in candidates]
    probable = probable_loops(pairs, model, motion.path, drift=drift, config=config)
    improbable = [
        RejectedClosure(pair.loop, rejection_reason(pair, model, config.min_probability))
        for pair, loop in zip(pairs, probable, strict=True)
        if loop is None
    ]
    likely = [loop for loop in probable if loop is not None]
    consistent_sets, contradicting = accept_between(likely, motion, drift=drift)

    rows = np.concatenate([match_finder.rows, query_finder.rows])  # scan of each frame of the joined motion

    def between_sessions(loop: LoopClosure) -> LoopClosure:
        """Convert a loop between gravity-aligned frames of the joined motion to LiDAR frames of scans."""
        loop = renumbered(to_lidar(loop, query=mountings[loop.query], match=mountings[loop.match]), [rows])
        return dataclasses.replace(loop, match_session=match, query_session=query)

    rejected = convert_rejected([*improbable, *contradicting], between_sessions)
    loops, transforms = list[LoopClosure](), list[SegmentAlignment]()
    for consistent in consistent_sets:
        accepted = list(map(between_sessions, consistent))
        if registered:
            options = {"knows_height": knows_height, "should_stop": should_stop}
            query_scans, match_scans = sessions[1].recording, sessions[0].recording
            accepted, without_overlap = register_loops(query_scans, match_scans, accepted, **options)
            rejected += without_overlap
        if accepted:
            transforms.append(_align_segments(accepted, sessions, motion, drift))
            loops += accepted
    return sorted(loops, key=lambda loop: (loop.query, loop.match)), ordered_rejections(rejected), transforms


def _candidates_between(
    matches: CandidateSearch,
    queries: CandidateSearch,
    motion: BevOdometry,
    drift: DriftModel,
    *,
    should_stop: Callable[[], bool],
    on_progress: Callable[[int], None],
) -> list[Candidate]:
    """Candidates of each stored scan of the queries' session in the matches' session, by their joined motion.

    Raises ValueError if the images of the two sessions have different sizes.
    """
    candidates, query_offset = list[Candidate](), len(matches)
    if not len(queries.stored) or not len(matches.stored):
        return candidates
    query_shape, match_shape = queries.stored.image(0).shape, matches.stored.image(0).shape
    if query_shape != match_shape:
        raise ValueError(f"expected images of one size in both recordings, found {match_shape} and {query_shape} cells")
    loops = np.concatenate([matches.loops.rows, queries.loops.rows + query_offset])
    comparer = KeyframeComparison(motion, drift, matches.config, matches.verification, loops)
    query_scans = queries.stored.view(first_frame=query_offset)
    for row, frame in enumerate(query_scans.frames.tolist()):
        if should_stop():
            break
        query = Query(frame, query_scans.index.descriptors[row], query_scans.image(row), matches.verification)
        fits = comparer.compare(query, matches.stored, query_scans)
        candidates += comparer.candidates(query, fits, matches.stored, possible=fits.frames < query_offset)
        on_progress(int(queries.rows[frame - query_offset]) + 1)
    return candidates


def _align_segments(
    loops: Sequence[LoopClosure], sessions: Sequence[SearchedSession], motion: BevOdometry, drift: DriftModel
) -> SegmentAlignment:
    """Estimate the transform between the two trajectory segments that loops connect.

    `sessions` are those of the matches and the queries, `motion` is their joined motion, and `drift` that of both.
    """
    segments, poses = [], []
    frames_of_scans = {}  # frame of each scan, by session
    for node, searched in zip(loops[0].nodes, sessions, strict=True):
        finder, odometry = searched.detector.finder, searched.odometry
        scans = np.arange(finder.scans)
        frames, segment_of_scan = np.searchsorted(finder.rows, scans), finder.segments_of(scans)
        frames_of_scans[node.session] = frames
        first, last = np.flatnonzero(segment_of_scan == segment_of_scan[node.frame])[[0, -1]].tolist()
        numbers = searched.recording.numbers
        segments.append(TrajectorySegment(node.session, int(numbers[first]), int(numbers[last]), odometry is not None))
        if odometry is None:
            lidar_poses = finder.motion.poses @ searched.recording.uprights[finder.rows]
            poses.append(inverse(lidar_poses[frames[first]]) @ lidar_poses)
        else:
            poses.append(odometry[finder.rows])
    match_poses, query_poses = poses
    match_m, query_m = np.split(motion.travelled, [len(match_poses)])
    distances = {"match_travelled_m": match_m, "query_travelled_m": query_m}
    loops = [renumbered(loop, frames_of_scans) for loop in loops]
    transform, covariance = align_frames(loops, match_poses, query_poses, drift=drift, **distances)
    return SegmentAlignment(segments[0], segments[1], transform, covariance, len(loops))
