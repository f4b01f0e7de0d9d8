"""Loops between two recordings: each stored scan of the second one is compared with the scans of the first one.

Comparison, probability and sequential test are those of a single recording. Scans of both recordings show other places.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.special import expit, logit

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.levelling import lidar_pose, mountings_of, upright_from_lidar, upright_odometry
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.data.scan_stream import OnBadScan
from sglpr_jax.loops.acceptance import registered_loops
from sglpr_jax.loops.arguments import check_is
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.closure import (
    Loop,
    Rejected,
    counted,
    divided_covariance,
    divided_loop,
    divided_rejected,
    listed,
    planar_loop,
    scaled_config,
    unseen_covariance,
)
from sglpr_jax.loops.comparison import Candidate, Comparer, Query
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.consistency import Joined, accepted_between
from sglpr_jax.loops.frame_alignment import FrameAlignment, aligned_frames
from sglpr_jax.loops.probability import LoopModel
from sglpr_jax.loops.search import FoundLoops, can_register, prepared, searched
from sglpr_jax.loops.sequence import Pair, tested_log_odds, verdict
from sglpr_jax.models.params import Params
from sglpr_jax.odometry.bev_odometry import Motion
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.registration.bev_spectra import query_spectra
from sglpr_jax.se3 import inverse, moved_covariance


def candidates_between(
    queries: CandidateFinder,
    matches: CandidateFinder,
    motion: Motion,
    *,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> list[Candidate]:
    """Find the best match of each stored scan of a recording in another recording.

    Arguments:
      queries: Finder after all scans of the recording whose scans are the queries.
      matches: Finder after all scans of the other recording.
      motion: Motion of both recordings, first that of the matches, in level worlds.
      should_stop: If it returns True, the remaining scans are not compared.
      on_progress: Called with the number of compared scans.

    Returns:
      At most one candidate for each stored scan, in order. Frames are those of `motion`.

    Raises:
      ValueError: If the images of the two recordings have other sizes.
    """
    found: list[Candidate] = []
    if not len(queries.stored) or not len(matches.stored):
        return found
    ours, theirs = (finder.stored.image(0).shape for finder in (queries, matches))
    if ours != theirs:
        raise ValueError(f"expected images of one size in both recordings, found {theirs} and {ours} cells")
    offset = len(matches)
    joined = np.concatenate([finder.joined + start for finder, start in ((matches, 0), (queries, offset))])
    comparer = Comparer(motion, queries.present_drift, np.eye(3), matches.config, matches.verification, joined)
    own = queries.stored.shifted(offset)
    for row, frame in enumerate(queries.stored.frames.tolist()):
        if should_stop():
            break
        image = queries.stored.image(row)
        spectra = query_spectra(image, config=matches.verification)
        query = Query(offset + frame, queries.index.descriptors[row], image, spectra)
        fits = comparer.compare(query, matches.stored, own)
        found += comparer.candidates(query, fits, matches.stored.image_of, possible=fits.frames < offset)
        on_progress(row + 1)
    return found


def probable_loops(
    candidates: Sequence[Candidate],
    model: LoopModel,
    motion: Motion,
    *,
    drift: DriftModel,
    knows_height: bool,
    config: DetectorConfig,
) -> tuple[list[Loop], list[Rejected]]:
    """Loops between two recordings that pass the sequential test, in gravity-aligned frames.

    Arguments:
      candidates: Pairs of `candidates_between`.
      model: Model of the probabilities.
      motion: Motion of both recordings (`Motion.joined`), first that of the matches.
      drift: Drift of the motion.
      knows_height: Whether the odometry measures height.
      config: Thresholds.

    Returns:
      The loops, and the other pairs with the reason for their rejection.
    """
    pairs = []
    for one in candidates:
        probability = float(model.probability(one.evidence))
        loop = planar_loop(one.query, one.match, one.alignment, probability=probability, knows_height=knows_height)
        pairs.append(Pair(loop, one.evidence, float(motion.travelled[one.query])))
    rules = {"mounting": None, "drift": drift, "consistency": config.consistency, "config": config.sequence}
    log_odds = tested_log_odds(pairs, model, motion.path, **rules)
    kept, rejected = [], []
    for pair, value in zip(pairs, log_odds, strict=True):
        if value >= logit(config.min_probability):
            kept.append(dataclasses.replace(pair.loop, probability=float(expit(value))))
        else:
            rejected.append(Rejected(pair.loop, verdict(pair, model, config.min_probability)))
    return kept, rejected


class Part(NamedTuple):
    """Frames of a recording whose poses are known in one frame: all of them if there is odometry."""

    first: int
    last: int
    """First and last row of the part."""
    is_odometry: bool
    """Whether the frame is that of the odometry. Otherwise it is the LiDAR's frame at the first row."""


@dataclasses.dataclass(frozen=True, eq=False)
class AlignedParts:
    """Transform between a part of one recording and a part of another."""

    match: Part
    query: Part
    alignment: FrameAlignment
    loops: int
    """Number of loops from which the transform was estimated."""


@dataclasses.dataclass(frozen=True, eq=False)
class FoundBetween:
    """Loops between two recordings. Queries are rows of the later recording, matches are rows of the earlier one."""

    match: int
    query: int
    """Numbers of the two recordings, counted from 0."""
    loops: tuple[Loop, ...]
    rejected: tuple[Rejected, ...]
    aligned: tuple[AlignedParts, ...]
    """Transforms between the frames, the one with most loops first. Empty if no common place was found. With odometry
    there is at most one."""
    compared: int
    """Number of scans of the later recording that were compared with the earlier one."""

    def divided(self, scale: Scale) -> "FoundBetween":
        """Results in metres of a search whose input was multiplied by `scale`."""
        return dataclasses.replace(
            self,
            loops=tuple(divided_loop(loop, scale) for loop in self.loops),
            rejected=tuple(divided_rejected(one, scale) for one in self.rejected),
            aligned=tuple(_divided_alignment(one, scale) for one in self.aligned),
        )


@dataclasses.dataclass(frozen=True, eq=False)
class FoundRecordings:
    """Loops within and between several recordings."""

    recordings: tuple[FoundLoops, ...]
    between: tuple[FoundBetween, ...]
    """One for each pair of recordings."""
    stopped: bool = False
    """Whether the search was stopped before its end."""

    @property
    def whole(self) -> bool:
        """Whether the search was completed."""
        return not self.stopped and all(found.whole for found in self.recordings)

    def without_degenerate(self) -> "FoundRecordings":
        """Reject the loops whose position is uncertain by more than 1 m in some horizontal direction. The transforms
        stay, because their weights contain this uncertainty.
        """
        within = tuple(one.without_degenerate() for one in self.recordings)
        return dataclasses.replace(self, recordings=within, between=tuple(map(_without_degenerate, self.between)))

    def __str__(self) -> str:
        return "\n".join([*map(str, self.recordings), *map(self._said, self.between)])

    def _said(self, one: FoundBetween) -> str:
        """One line about the loops between two recordings."""
        names = f"{self.recordings[one.match].recording.name} and {self.recordings[one.query].recording.name}"
        why = f" ({listed(counted(one.rejected))})" if one.rejected else ""
        if not one.aligned:
            return f"{names}: no common place found{why}"
        said = "; ".join(_transform_in_words(aligned) for aligned in one.aligned)
        return f"{names}: {len(one.loops)} loops, {len(one.rejected)} rejected{why}; {said}"


def _divided_alignment(one: AlignedParts, scale: Scale) -> AlignedParts:
    alignment = FrameAlignment(
        scaled_poses(one.alignment.match_from_query, 1 / scale), divided_covariance(one.alignment.covariance, scale)
    )
    return dataclasses.replace(one, alignment=alignment)


def _without_degenerate(one: FoundBetween) -> FoundBetween:
    kept = tuple(loop for loop in one.loops if not loop.is_degenerate)
    others = [Rejected(loop, "degenerate") for loop in one.loops if loop.is_degenerate]
    rejected = tuple(sorted([*one.rejected, *others], key=lambda other: (other.loop.query, other.loop.match)))
    return dataclasses.replace(one, loops=kept, rejected=rejected)


def _transform_in_words(aligned: AlignedParts) -> str:
    """The transform between two frames in one line, with standard deviations."""
    (x, y, z), sigma = aligned.alignment.match_from_query[:3, 3], np.sqrt(np.diag(aligned.alignment.covariance))
    yaw = np.degrees(np.arctan2(*aligned.alignment.match_from_query[[1, 0], 0]))
    parts = ""
    if not aligned.match.is_odometry:
        parts = " of scans {}-{} and {}-{}".format(*aligned.match[:2], *aligned.query[:2])
    return (
        f"transform{parts} x {x:.2f}, y {y:.2f}, z {z:.2f} m, yaw {yaw:.2f} degrees "
        f"(+- {np.hypot(*sigma[:2]):.2f} m, {np.degrees(sigma[5]):.2f} degrees)"
    )


def find_loops_between(
    recordings: Sequence[Recording],
    params: Params,
    *,
    odometry: Sequence[ArrayLike] | None = None,
    model: LoopModel | None = None,
    config: DetectorConfig = DetectorConfig(),
    registered: bool | None = None,
    scale: Scale = 1,
    on_bad_scan: OnBadScan | None = None,
    kept_in: Path | str | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> FoundRecordings:
    """Find the loops within each recording, and between recordings that have no common frame.

    The loops within a recording are those of `find_loops`. Loops between two recordings are accepted if at least five
    of them, over at least 15 m of both recordings, fit one transform between the frames and no other transform fits
    half as many. Otherwise none is accepted and there is no transform.

    Without odometry, the motion estimated from the images is used. Where this motion is unknown, a recording consists
    of several parts, and each part is aligned by its own loops.

    Arguments:
      recordings: At least two recordings.
      params: Weights of the model that describes the scans.
      odometry: Poses of the LiDAR at the scans of each recording, in a frame of the recording.
      model: See `find_loops`, also for the other arguments.
      config: Settings of the detector.
      registered: Register the full scans of each loop. None registers them if all recordings can be registered.
      scale: Factor for all lengths during the search, the same for all recordings.
      on_bad_scan: Called with id and error of a scan that cannot be read.
      kept_in: Checkpoint directory. It gets a folder for each recording.
      should_stop: If it returns True, the search ends with the loops that were found.
      on_progress: Called with the number of finished steps. A search takes one step for each scan. A comparison of two
        recordings takes one step for each scan of the second one.

    Raises:
      ValueError: If there are fewer than two recordings, or odometry for another number of recordings. Errors of
        `find_loops` are raised, too.

    Example:
      first, second = (sglpr_jax.open_recording(path) for path in ("monday", "tuesday"))
      found = find_loops_between([first, second], sglpr_jax.load("sglpr"))
      if found.between[0].aligned:
          print(found.between[0].aligned[0].alignment.match_from_query)
    """
    recordings = tuple(recordings)
    if len(recordings) < 2:
        raise ValueError(f"expected at least two recordings, found {len(recordings)}; use find_loops for one")
    given = [None] * len(recordings) if odometry is None else list(odometry)
    if len(given) != len(recordings):
        raise ValueError(f"expected odometry of {len(recordings)} recordings, found that of {len(given)}")
    for recording in recordings:
        check_is(recording, Recording, by="open_recording")
    registered = all(map(can_register, recordings)) if registered is None else registered
    inputs = [
        prepared(recording, poses, config, registered=registered)
        for recording, poses in zip(recordings, given, strict=True)
    ]
    steps, searches = 0, []
    for number, (recording, one_given) in enumerate(zip(recordings, inputs, strict=True)):
        one = searched(
            one_given.scaled(scale),
            params,
            model=model,
            registered=registered,
            scale=scale,
            on_bad_scan=on_bad_scan,
            kept_in=None if kept_in is None else Path(kept_in) / f"{number}",
            should_stop=should_stop,
            on_progress=lambda done, before=steps: on_progress(before + done),
        )
        searches.append(one)
        steps += len(recording)
    between = []
    for match, query in itertools.combinations(range(len(recordings)), 2):
        pair = between_searches(
            match,
            query,
            searches,
            config=scaled_config(config, scale),
            registered=registered,
            should_stop=should_stop,
            on_progress=lambda done, before=steps: on_progress(before + done),
        )
        between.append(pair.divided(scale))
        steps += len(recordings[query])
    within = tuple(found.divided(one_given, scale) for (found, _), one_given in zip(searches, inputs, strict=True))
    return FoundRecordings(within, tuple(between), stopped=should_stop())


def between_searches(
    match: int,
    query: int,
    searches: Sequence[tuple[FoundLoops, CandidateFinder]],
    *,
    config: DetectorConfig = DetectorConfig(),
    registered: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> FoundBetween:
    """Loops and transforms between two recordings, numbers `match` and `query` of the finished searches."""
    found, finders = zip(*(searches[number] for number in (match, query)), strict=True)
    levels = [finder.motion.path.level(finder.mountings) for finder in finders]
    motion, offset = Motion.joined([finder.motion for finder in finders], levels), len(finders[0])
    steps = {"should_stop": should_stop, "on_progress": on_progress}
    candidates = candidates_between(finders[1], finders[0], motion, **steps)
    model, drift = found[0].model, finders[1].present_drift
    assert model is not None  # the searches have one
    knows_height = all(finder.knows_height for finder in finders)
    rules = {"drift": drift, "knows_height": knows_height, "config": config}
    probable, rejected = probable_loops(candidates, model, motion, **rules)
    joined = _joined(found, motion)
    sets, contradicting = accepted_between(probable, joined, drift=drift, config=config.consistency)
    aligned, loops = [], []
    for upright in sets:
        some = [_of_lidars(loop, found, offset) for loop in upright]
        if registered:
            both = found[1].recording, found[0].recording
            some, little = registered_loops(*both, some, knows_height=knows_height, should_stop=should_stop)
            rejected = [*rejected, *little]
        if some:
            aligned.append(_aligned(some, found, finders, joined, offset, drift))
            loops += some
    lost = [dataclasses.replace(one, loop=_of_lidars(one.loop, found, offset)) for one in [*rejected, *contradicting]]
    return FoundBetween(
        match,
        query,
        tuple(sorted(loops, key=lambda loop: (loop.query, loop.match))),
        tuple(sorted(lost, key=lambda one: (one.loop.query, one.loop.match))),
        tuple(aligned),
        len(candidates),
    )


def _joined(found: Sequence[FoundLoops], motion: Motion) -> Joined:
    """Gravity-aligned poses of two recordings: by odometry if there is odometry, otherwise by their motion."""
    level = [
        upright_odometry(one.odometry[: one.frames], mountings_of(one.recording))
        for one in found
        if one.odometry is not None
    ]
    return Joined(np.concatenate(level) if level else motion.poses, motion.travelled, motion.segments)


def _of_lidars(loop: Loop, found: Sequence[FoundLoops], offset: int) -> Loop:
    """Convert a loop from gravity-aligned frames and joined rows to LiDAR frames and rows of the two recordings."""
    upright, frame = loop.match_from_query, loop.query - offset
    match, query = found[0].recording.mounting_of(loop.match), found[1].recording.mounting_of(frame)
    estimated = unseen_covariance(upright, query, match) - unseen_covariance(upright)
    covariance = moved_covariance(loop.covariance + estimated, inverse(upright_from_lidar(query)))
    pose = lidar_pose(upright, query=query, match=match)
    return dataclasses.replace(loop, query=frame, match_from_query=pose, covariance=covariance)


def _aligned(
    loops: Sequence[Loop],
    found: Sequence[FoundLoops],
    finders: Sequence[CandidateFinder],
    joined: Joined,
    offset: int,
    drift: DriftModel,
) -> AlignedParts:
    """Transform between the parts of two recordings to which some loops belong."""
    parts, poses = [], []
    for one, finder, frame in zip(found, finders, (loops[0].match, loops[0].query), strict=True):
        segments = finder.motion.segments
        rows = np.flatnonzero(segments == segments[frame])
        part = Part(int(rows[0]), int(rows[-1]), one.odometry is not None)
        parts.append(part)
        poses.append(_poses_in(part, one, finder))
    ways = np.split(joined.travelled, [offset])
    alignment = aligned_frames(loops, *poses, match_way=ways[0], query_way=ways[1], drift=drift)
    return AlignedParts(parts[0], parts[1], alignment, len(loops))


def _poses_in(part: Part, found: FoundLoops, finder: CandidateFinder) -> Float[np.ndarray, "n 4 4"]:
    """Pose of the LiDAR at each frame of a recording, in the frame of a part."""
    if found.odometry is not None:
        return found.odometry[: found.frames]
    poses = finder.motion.poses @ finder.mountings.uprights(np.arange(len(finder)))
    return inverse(poses[part.first]) @ poses
