"""Correction of the odometry of several recordings by the loops within and between them (extra `gtsam`)."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.loops.find_between import FoundRecordings
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.mountings import mountings_of, upright_from_lidar, uprights
from sglpr_jax.loops.optimization import OptimizedTrajectory, optimized
from sglpr_jax.loops.transforms import inverse, moved_covariance
from sglpr_jax.loops.upright import upright_odometry


class OptimizedRecordings(NamedTuple):
    """Corrected trajectories of several recordings."""

    poses: tuple[Float[np.ndarray, "_ 4 4"], ...]
    """Pose of the LiDAR at each searched frame of each recording, in the frame of its group's first recording."""
    groups: tuple[tuple[int, ...], ...]
    """Numbers of the recordings that loops connect, each group in order. Groups have different frames."""
    corrections: tuple[OptimizedTrajectory, ...]
    """Correction of each group. Its poses are those of gravity-aligned frames."""


def placements(found: FoundRecordings) -> tuple[tuple[int, Float[np.ndarray, "4 4"]], ...]:
    """Return the group of each recording, and the transform from its odometry frame to that of the group's first one.

    Groups are named by the number of their first recording. Transforms with more loops are used first. Recordings
    without odometry, or without a common place, are groups of their own.
    """
    placed: dict[int, tuple[int, np.ndarray]] = {}
    links = [(len(one.loops), one) for one in found.between if one.aligned and one.aligned[0].match.is_odometry]
    links.sort(key=lambda link: -link[0])
    for root in range(len(found.recordings)):
        placed.setdefault(root, (root, np.eye(4)))
        grown = True
        while grown:
            grown = False
            for _, one in links:
                match_from_query = one.aligned[0].alignment.match_from_query
                for known, new, known_from_new in (
                    (one.match, one.query, match_from_query),
                    (one.query, one.match, inverse(match_from_query)),
                ):
                    if known in placed and new not in placed:
                        group, first_from_known = placed[known]
                        placed[new] = group, first_from_known @ known_from_new
                        grown = True
                if grown:
                    break
    return tuple(placed[number] for number in range(len(found.recordings)))


def optimize_recordings(found: FoundRecordings) -> OptimizedRecordings:
    """Correct the odometry of all recordings by all loops. Recordings that loops connect get one frame.

    Arguments:
      found: Loops found with odometry.

    Raises:
      ValueError: If the loops were found without odometry.
      ImportError: If the extra `gtsam` is not installed.
    """
    without = next((one.recording.name for one in found.recordings if one.odometry is None), None)
    if without is not None:
        raise ValueError(f"{without}: expected loops found with odometry, found loops without it")
    placed = placements(found)
    poses: dict[int, np.ndarray] = {}
    groups, corrections = [], []
    for group in dict.fromkeys(group for group, _ in placed):
        members = tuple(number for number, (other, _) in enumerate(placed) if other == group)
        corrected, parts = _optimized_group(found, members, [placed[number][1] for number in members])
        poses |= dict(zip(members, parts, strict=True))
        groups.append(members)
        corrections.append(corrected)
    return OptimizedRecordings(tuple(poses[number] for number in sorted(poses)), tuple(groups), tuple(corrections))


def _optimized_group(
    found: FoundRecordings, members: Sequence[int], first_from_members: Sequence[Float[np.ndarray, "4 4"]]
) -> tuple[OptimizedTrajectory, list[Float[np.ndarray, "_ 4 4"]]]:
    """Correct the recordings of a group together, in gravity-aligned frames, because their mountings may differ."""
    some = [found.recordings[number] for number in members]
    mountings = [mountings_of(one.recording) for one in some]
    odometry = [one.odometry[: one.frames] for one in some if one.odometry is not None]
    level = np.eye(4)
    if len(odometry[0]):
        first = odometry[0][0] @ inverse(uprights(mountings[0], 0))
        level = upright_odometry(odometry[0], mountings[0])[0] @ inverse(first)
    upright = [
        level @ to_first @ poses @ inverse(uprights(mounting, np.arange(len(poses))))
        for to_first, poses, mounting in zip(first_from_members, odometry, mountings, strict=True)
    ]
    starts = np.cumsum([0, *(len(poses) for poses in upright)])[:-1].tolist()
    start_of = dict(zip(members, starts, strict=True))
    loops = _joined_loops(found, start_of)
    corrected = optimized(np.concatenate(upright), tuple(loops), drift=some[0].drift, starts=starts)
    parts = [
        inverse(level) @ poses @ uprights(mounting, np.arange(len(poses)))
        for poses, mounting in zip(np.split(corrected.poses, starts[1:]), mountings, strict=True)
    ]
    return corrected, parts


def _joined_loops(found: FoundRecordings, start_of: dict[int, int]) -> list[Loop]:
    """Loops within and between the recordings of a group, in gravity-aligned frames and joined rows."""
    of = [(number, number, found.recordings[number].loops) for number in start_of]
    of += [(one.match, one.query, one.loops) for one in found.between if {one.match, one.query} <= set(start_of)]
    joined = []
    for match, query, loops in of:
        ours_of, theirs_of = (found.recordings[number].recording.mounting_of for number in (query, match))
        for loop in loops:
            ours, theirs = ours_of(loop.query), theirs_of(loop.match)
            pose = upright_from_lidar(theirs) @ loop.match_from_query @ inverse(upright_from_lidar(ours))
            covariance = moved_covariance(loop.covariance, upright_from_lidar(ours))
            values = {"query": loop.query + start_of[query], "match": loop.match + start_of[match]}
            joined.append(dataclasses.replace(loop, **values, match_from_query=pose, covariance=covariance))
    return joined
