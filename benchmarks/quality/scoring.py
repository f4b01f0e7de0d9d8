"""Scores of loops: right and wrong ones, recall of revisits, errors of poses, and calibration."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from benchmarks.described import REPEATING_M, WAY_M
from benchmarks.drives import Drive, revisited
from sglpr_jax.se3 import distances, inverse, travelled, yaw_of
from sglpr_jax.sim.styles import SCENERIES

Poses = Float[np.ndarray, "n 4 4"]
LOOP_M, OTHER_M, REVISIT_M = 10.0, 20.0, 5.0
"""In towns, a loop is right up to the first distance and wrong beyond the second; a revisit is within the third."""
OLDER_S, OLDER_FRAMES = 30.0, 291
"""A revisit is of a place that was seen this time before, or this number of frames before if scans have no times."""
RIGHT, WRONG = (1.5, 6.0), (3.0, 15.0)
"""Largest errors of a right pose, and smallest errors of a wrong one, in metres and degrees."""
STOREY_M, SLOPE = 1.6, 0.3
"""Difference in height of scans on different storeys, in metres, and steepest slope between scans of one place."""
ALIAS_M, ALIAS_DEG = 3.0, 10.0
"""Poses farther off are another peak of the correlation."""
SUCCESS_M, SUCCESS_DEG = 2.0, 5.0


class Closure(NamedTuple):
    """A loop between two groups of scans, such as local maps. A loop of two scans has groups of one."""

    newer: Int[np.ndarray, " a"]
    older: Int[np.ndarray, " b"]


class Rule(NamedTuple):
    """Distances that decide about loops, and the scans that revisit a place."""

    right_m: float
    wrong_m: float
    revisits: Bool[np.ndarray, " n"]


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
    """The rule of towns and of KITTI. A loop is right within 10 m; a revisit is within 5 m after 30 s."""
    progress = np.arange(len(positions), dtype=float) if times is None else times
    apart = OLDER_FRAMES if times is None else OLDER_S
    return Rule(LOOP_M, OTHER_M, revisited(positions, progress, near_m=REVISIT_M, apart=apart))


def rule_of(drive: Drive, poses: Poses, times: Float[np.ndarray, " n"]) -> Rule:
    """The rule of a simulated drive. Where places repeat, scans more than `other_m` apart show different places."""
    if drive.world in SCENERIES:
        return town_rule(poses[:, :3, 3], times)
    near_m = min(REPEATING_M, drive.other_m / 2)
    is_revisit = revisited(poses[:, :3, 3], travelled(poses), near_m=near_m, apart=WAY_M)
    return Rule(drive.other_m, drive.other_m, is_revisit)


def counted(closures: Sequence[Closure], positions: Float[np.ndarray, "n 3"], rule: Rule) -> Counts:
    """Count loops. A loop is right if two of its scans are near each other, and wrong if all are far apart."""
    right, wrong, matched = 0, 0, set[int]()
    for newer, older in closures:
        apart = distances(positions[newer], positions[older]).min(axis=1)
        right, wrong = right + int(apart.min() <= rule.right_m), wrong + int(apart.min() > rule.wrong_m)
        matched |= set(newer[apart <= rule.right_m].tolist())
    revisits = set(np.flatnonzero(rule.revisits).tolist())
    return Counts(len(closures), right, wrong, len(revisits & matched), len(revisits))


def closures_of(loops: Sequence[Any]) -> list[Closure]:
    """Closures of loops of two scans."""
    return [Closure(np.array([one.query]), np.array([one.match])) for one in loops]


def relative_errors(loops: Sequence[Any], poses: Poses) -> Float[np.ndarray, "k 4 4"]:
    """The found pose of each query in its match, in the frame of the true one."""
    found = [inverse(inverse(poses[one.match]) @ poses[one.query]) @ one.match_from_query for one in loops]
    return np.array(found).reshape(-1, 4, 4)


def twist(error: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 6"]:
    """A small motion as metres and radians."""
    return np.concatenate([error[:3, 3], Rotation.from_matrix(error[:3, :3]).as_rotvec()])


def is_alias(error: Float[np.ndarray, "4 4"]) -> bool:
    """Whether a pose is another peak of the correlation."""
    away = twist(error)
    return bool(np.linalg.norm(away[:2]) > ALIAS_M or np.linalg.norm(away[3:]) > np.radians(ALIAS_DEG))


def told(loops: Sequence[Any], poses: Poses) -> str:
    """Errors of poses in the plane, in words."""
    if not len(loops):
        return "no loops"
    errors = relative_errors(loops, poses)
    metres, degrees = np.linalg.norm(errors[:, :2, 3], axis=1), np.abs(np.degrees(yaw_of(errors)))
    success = np.mean((metres < SUCCESS_M) & (degrees < SUCCESS_DEG))
    within = f"{len(loops)} poses, {success:.4f} within {SUCCESS_M:g} m and {SUCCESS_DEG:g} degrees"
    return f"{within}, median {np.median(metres):.3f} m and {np.median(degrees):.3f} degrees"


class PoseErrors(NamedTuple):
    """Errors of pairs against the true poses, one number for each pair."""

    metres: Float[np.ndarray, " k"]
    """In the plane of the match."""
    degrees: Float[np.ndarray, " k"]
    """Of the heading."""
    storey_m: Float[np.ndarray, " k"]
    """Difference in height between the scans, as far as it exceeds a slope of `SLOPE` between them."""

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
    """Errors of the poses of pairs (query, match)."""
    frames = np.array(pairs, np.int64).reshape(-1, 2)
    query, match = world_from_lidar[frames[:, 0]], world_from_lidar[frames[:, 1]]
    true, found = inverse(match) @ query, np.reshape(match_from_query, (-1, 4, 4))
    apart = np.linalg.norm((found - true)[:, :2, 3], axis=1)
    turned = np.degrees(np.abs((yaw_of(found) - yaw_of(true) + np.pi) % (2 * np.pi) - np.pi))
    up = np.abs(query[:, 2, 3] - match[:, 2, 3]) - SLOPE * np.linalg.norm((query - match)[:, :2, 3], axis=1)
    return PoseErrors(apart, turned, up)
