"""Scores of loops: right and wrong ones, recall of revisits, errors of poses, and calibration."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from benchmarks.described import REPEATING_M, WAY_M
from benchmarks.drives import Drive, is_revisit
from sglpr_jax.se3 import inverse, lengths_along, travelled, wrap_angle, yaw_of
from sglpr_jax.sim.styles import SCENERIES

Poses = Float[np.ndarray, "n 4 4"]
LOOP_M, OTHER_M, REVISIT_M = 10.0, 20.0, 5.0
"""Distances in towns, in metres: a loop is right up to the first and wrong beyond the second. A revisit of a place is
within the third."""
OLDER_S, OLDER_FRAMES = 30.0, 291
"""Minimum age of a revisited place in seconds, or in frames if the scans have no times."""
RIGHT, WRONG = (1.5, 6.0), (3.0, 15.0)
"""Largest errors of a right pose, and smallest errors of a wrong one, in metres and degrees."""
STOREY_M, SLOPE = 1.6, 0.3
"""Difference in height of scans on different storeys, in metres, and steepest slope between scans of one place."""
ALIAS_M, ALIAS_DEG = 3.0, 10.0
"""Errors above which a pose belongs to another peak of the correlation, in metres and degrees."""
KEYFRAME_M = 3.0
"""Path length around a keyframe whose scans it represents, in metres, because they are not searched."""
SUCCESS_M, SUCCESS_DEG = 2.0, 5.0  # largest errors of a successful registration


class Closure(NamedTuple):
    """A loop between two groups of scans, such as local maps. A loop of two scans has groups of one."""

    newer: Int[np.ndarray, " a"]
    older: Int[np.ndarray, " b"]


class Rule(NamedTuple):
    """Distances that define right and wrong loops, and the scans that revisit a place."""

    right_m: float  # maximum distance of the scans of a right loop
    wrong_m: float  # distance above which a loop is wrong
    revisits: Bool[np.ndarray, " n"]  # whether each scan revisits a place


class Counts(NamedTuple):
    """Loops of a drive, and scans that revisit a place."""

    loops: int
    right: int
    wrong: int
    found: int
    """Revisits in a right loop."""
    revisits: int

    @property
    def recall(self) -> str:
        """Share of the revisits that were found, as a cell."""
        return f"{self.found / self.revisits:.3f} of {self.revisits}" if self.revisits else "-"


def town_rule(positions: Float[np.ndarray, "n 3"], times: Float[np.ndarray, " n"] | None) -> Rule:
    """Rule of towns and of KITTI: a loop is right within 10 m. A revisit is within 5 m of a place seen 30 s before."""
    progress = np.arange(len(positions), dtype=float) if times is None else times
    min_progress = OLDER_FRAMES if times is None else OLDER_S
    return Rule(LOOP_M, OTHER_M, is_revisit(positions, progress, near_m=REVISIT_M, min_progress=min_progress))


def rule_of(drive: Drive, poses: Poses, times: Float[np.ndarray, " n"]) -> Rule:
    """Rule of a simulated drive. In repeating sceneries, loops are right up to `other_m` and wrong beyond."""
    if drive.world in SCENERIES:
        return town_rule(poses[:, :3, 3], times)
    near_m = min(REPEATING_M, drive.other_m / 2)
    revisits = is_revisit(poses[:, :3, 3], travelled(poses), near_m=near_m, min_progress=WAY_M)
    return Rule(drive.other_m, drive.other_m, revisits)


def count_loops(closures: Sequence[Closure], positions: Float[np.ndarray, "n 3"], rule: Rule) -> Counts:
    """Counts loops. A loop is right if two of its scans are near each other, and wrong if all are far apart."""
    right, wrong, found_scans = 0, 0, set[int]()
    for newer, older in closures:
        distance = cdist(positions[newer], positions[older]).min(axis=1)  # of each newer scan
        right += int(distance.min() <= rule.right_m)
        wrong += int(distance.min() > rule.wrong_m)
        found_scans |= set(newer[distance <= rule.right_m].tolist())
    revisits = set(np.flatnonzero(rule.revisits).tolist())
    return Counts(len(closures), right, wrong, len(revisits & represented(found_scans, positions)), len(revisits))


def represented(scans: Iterable[int], positions: Float[np.ndarray, "n 3"]) -> set[int]:
    """The scans, and those within `KEYFRAME_M` of path of one of them."""
    travelled_m = lengths_along(positions)
    found_m = travelled_m[sorted(scans)]
    is_near = (np.abs(travelled_m[:, None] - found_m[None]) <= KEYFRAME_M).any(axis=1)
    return set(np.flatnonzero(is_near).tolist())


def closures_of(loops: Sequence[Any]) -> list[Closure]:
    """Converts loops of two scans, with fields `query` and `match`, to closures."""
    return [Closure(np.array([loop.query]), np.array([loop.match])) for loop in loops]


def relative_errors(loops: Sequence[Any], poses: Poses) -> Float[np.ndarray, "k 4 4"]:
    """Estimated pose of each query in the frame of its true pose."""
    errors = [inverse(inverse(poses[loop.match]) @ poses[loop.query]) @ loop.match_from_query for loop in loops]
    return np.array(errors).reshape(-1, 4, 4)


def twist(error: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 6"]:
    """Converts a small transform to translation in metres and rotation vector in radians."""
    return np.concatenate([error[:3, 3], Rotation.from_matrix(error[:3, :3]).as_rotvec()])


def is_alias(error: Float[np.ndarray, "4 4"]) -> bool:
    """Whether the error is so large that the pose belongs to another peak of the correlation."""
    xyz_and_rotation = twist(error)
    distance_m, angle = np.linalg.norm(xyz_and_rotation[:2]), np.linalg.norm(xyz_and_rotation[3:])
    return bool(distance_m > ALIAS_M or angle > np.radians(ALIAS_DEG))


def describe_errors(loops: Sequence[Any], poses: Poses) -> str:
    """Text with the share of successful poses of loops and their median errors in x and y and in yaw."""
    if not len(loops):
        return "no loops"
    errors = relative_errors(loops, poses)
    metres, degrees = np.linalg.norm(errors[:, :2, 3], axis=1), np.abs(np.degrees(yaw_of(errors)))
    success = np.mean((metres < SUCCESS_M) & (degrees < SUCCESS_DEG))
    success_text = f"{len(loops)} poses, {success:.4f} within {SUCCESS_M:g} m and {SUCCESS_DEG:g} degrees"
    return f"{success_text}, median {np.median(metres):.3f} m and {np.median(degrees):.3f} degrees"


class PoseErrors(NamedTuple):
    """Errors of pairs against the true poses, one number for each pair."""

    metres: Float[np.ndarray, " k"]  # error of x and y in the frame of the match
    degrees: Float[np.ndarray, " k"]  # error of yaw
    storey_m: Float[np.ndarray, " k"]
    """Difference in height between the scans, minus that of a slope of `SLOPE` between them."""

    @property
    def right(self) -> Bool[np.ndarray, " k"]:
        """Whether each pose is right."""
        return (self.metres <= RIGHT[0]) & (self.degrees <= RIGHT[1]) & (self.storey_m <= STOREY_M)

    @property
    def wrong(self) -> Bool[np.ndarray, " k"]:
        """Whether each pose is certainly wrong. Poses between right and wrong are neither."""
        return (self.metres > WRONG[0]) | (self.degrees > WRONG[1]) | (self.storey_m > STOREY_M)


def pose_errors(
    pairs: Sequence[tuple[int, int]], match_from_query: Float[np.ndarray, "k 4 4"], world_from_lidar: Poses
) -> PoseErrors:
    """Errors of the estimated poses `match_from_query` of pairs (query, match)."""
    frames = np.array(pairs, np.int64).reshape(-1, 2)
    query, match = world_from_lidar[frames[:, 0]], world_from_lidar[frames[:, 1]]
    true, estimated = inverse(match) @ query, np.reshape(match_from_query, (-1, 4, 4))
    metres = np.linalg.norm((estimated - true)[:, :2, 3], axis=1)
    degrees = np.degrees(np.abs(wrap_angle(yaw_of(estimated) - yaw_of(true))))
    storey_m = np.abs(query[:, 2, 3] - match[:, 2, 3]) - SLOPE * np.linalg.norm((query - match)[:, :2, 3], axis=1)
    return PoseErrors(metres, degrees, storey_m)
