"""A loop closure: two scans of one place, and the pose of one relative to the other."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.mounting import Mounting, upright_from_lidar
from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.se3 import PlanarPose, inverse, planar_pose, transform_covariance, yaw_of

Reason = Literal[
    "little similarity",
    "repeats",
    "too few neighbours",
    "contradicts the motion",
    "contradicts the odometry",
    "contradicts other loops",
    "little overlap",
    "degenerate",
]
"""Why a compared pair is not a loop closure."""
HEIGHT_M, HEIGHT_PER_M = 0.03, 0.018
TILT_DEG, TILT_DEG_PER_M = 1.2, 0.07
"""Standard deviations of height, and of pitch and roll, which images do not show: for two scans at one position, and
their increase per metre between the scans. They hold for vehicles, in simulated towns and outskirts and on KITTI."""
GROUND_HEIGHT_PER_M, GROUND_TILT_DEG_PER_M = 0.008, 0.03
"""Increase of these standard deviations per metre between two scans whose mountings were estimated from the scans."""
UNKNOWN_HEIGHT_M = 10.0
"""Standard deviation of the height of a loop if nothing measures height: the scans may be on two storeys."""
DEGENERATE_M = 1.0
"""Maximum standard deviation of the position of a pose that is not degenerate, in metres."""
PLANAR = np.array([0, 1, 5])
"""Rows of x, y and yaw in a covariance of 6 degrees of freedom."""


class FrameId(NamedTuple):
    """A frame of a session, both counted from 0: a node of a pose graph."""

    session: int
    frame: int


@dataclasses.dataclass(frozen=True, eq=False)
class LoopClosure:
    """Two frames of one place, with the relative pose of their scans."""

    query: int
    match: int
    """Frames, counted from 0 in each session. If both are of one session, the match is the earlier frame."""
    match_from_query: Float[np.ndarray, "4 4"]
    """Pose of the query's LiDAR in the frame of the match's LiDAR, in metres. The points of the scans are in these
    frames, which are tilted if the sensor is tilted."""
    covariance: Float[np.ndarray, "6 6"]
    """Covariance of a small motion of the query in its own frame: x, y, z in metres, then rotations about x, y, z in
    radians."""
    probability: float
    """Probability that both frames show one place."""
    overlap: float | None = None
    """Overlap of the scans, from 0 to 1, if they were registered in 6 degrees of freedom."""
    query_session: int = 0
    match_session: int = 0
    """Sessions of the two frames, counted from 0. The match is in the same session or in an earlier one."""

    @property
    def nodes(self) -> tuple[FrameId, FrameId]:
        """The match and the query, as nodes of a pose graph."""
        return FrameId(self.match_session, self.match), FrameId(self.query_session, self.query)

    @property
    def yaw(self) -> float:
        """Rotation of the query in the match's frame, in radians counter-clockwise."""
        return float(yaw_of(self.match_from_query))

    @property
    def information(self) -> Float[np.ndarray, "6 6"]:
        """The inverse of the covariance."""
        return np.linalg.inv(self.covariance)


def to_upright(loop: LoopClosure, *, query: Mounting | None, match: Mounting | None) -> LoopClosure:
    """Convert a loop between LiDAR frames to one between gravity-aligned frames, by the mountings of both sensors."""
    return _between_frames(loop, upright_from_lidar(query), upright_from_lidar(match))


def to_lidar(loop: LoopClosure, *, query: Mounting | None, match: Mounting | None) -> LoopClosure:
    """Convert a loop between gravity-aligned frames to one between LiDAR frames, by the mountings of both sensors."""
    return _between_frames(loop, inverse(upright_from_lidar(query)), inverse(upright_from_lidar(match)))


def _between_frames(
    loop: LoopClosure, new_from_query: Float[np.ndarray, "4 4"], new_from_match: Float[np.ndarray, "4 4"]
) -> LoopClosure:
    """Express a loop between other frames of its scans, given the poses of the old frames in the new ones."""
    pose = new_from_match @ loop.match_from_query @ inverse(new_from_query)
    covariance = transform_covariance(loop.covariance, new_from_query)
    return dataclasses.replace(loop, match_from_query=pose, covariance=covariance)


def vertical_covariance(
    match_from_query: Float[np.ndarray, "4 4"], query: Mounting | None = None, match: Mounting | None = None
) -> Float[np.ndarray, "6 6"]:
    """Covariance of height, roll and pitch of a query in its own frame, relative to a match. Both are gravity-aligned.

    Suspension, bumps and slopes change height and tilt, the more the farther the scans are apart. If a mounting was
    estimated from its scan, its standard deviations count instead. A tilted match lifts the query.
    """
    apart_m = float(np.hypot(*match_from_query[:2, 3]))
    if not any(sensor is not None and sensor.tilt_deviation_deg is not None for sensor in (query, match)):
        height_m, tilt_deg = np.hypot(HEIGHT_M, HEIGHT_PER_M * apart_m), np.hypot(TILT_DEG, TILT_DEG_PER_M * apart_m)
        return _height_and_tilt(height_m, tilt_deg)
    covariances = []
    for sensor in (query, match):
        if sensor is None or sensor.height_deviation_m is None or sensor.tilt_deviation_deg is None:
            covariances.append(_height_and_tilt(HEIGHT_M / 2**0.5, TILT_DEG / 2**0.5))  # half of the variance of a pair
        else:
            covariances.append(_height_and_tilt(sensor.height_deviation_m, sensor.tilt_deviation_deg))
    match_in_query_frame = transform_covariance(covariances[1], inverse(match_from_query))
    ground = _height_and_tilt(GROUND_HEIGHT_PER_M * apart_m, GROUND_TILT_DEG_PER_M * apart_m)
    return covariances[0] + match_in_query_frame + ground


def _height_and_tilt(height_m: float, tilt_deg: float) -> Float[np.ndarray, "6 6"]:
    """Covariance of a pose with these standard deviations of height, and of roll and pitch, and 0 for the rest."""
    tilt = np.radians(tilt_deg)
    return np.diag([0.0, 0.0, height_m, tilt, tilt, 0.0]) ** 2


@dataclasses.dataclass(frozen=True, eq=False)
class RejectedClosure:
    """A compared pair that is not accepted as a loop closure, and the reason."""

    loop: LoopClosure
    reason: Reason


def planar_loop(
    query: int,
    match: int,
    registration: BevRegistration,
    *,
    probability: float,
    knows_height: bool = True,
    sensors: tuple[Mounting | None, Mounting | None] = (None, None),
) -> LoopClosure:
    """Loop closure of two registered images, between gravity-aligned frames.

    If the odometry does not measure height (`knows_height`), the storey is unknown. `sensors` are the mountings of
    query and match.
    """
    pose = registration.match_from_query
    covariance = vertical_covariance(pose, *sensors)
    covariance[2, 2] += 0.0 if knows_height else UNKNOWN_HEIGHT_M**2
    query_from_match = np.eye(3)  # rotation of (x, y, yaw)
    query_from_match[:2, :2] = pose[:2, :2].T
    match_covariance = np.asarray(registration.covariance, np.float64)
    covariance[PLANAR[:, None], PLANAR] = query_from_match @ match_covariance @ query_from_match.T
    return LoopClosure(query, match, pose, covariance, float(probability))


def planar_measurements(loops: Sequence[LoopClosure]) -> tuple[PlanarPose, Float[np.ndarray, "n 3 3"]]:
    """Planar pose of each query in the frame of its match, and its covariance in the frame of the query.

    Standard deviations are limited to `DEGENERATE_M` along every direction. Otherwise a pose that may lie anywhere
    along a wall would agree with every other pose along the wall.
    """
    poses = np.array([loop.match_from_query for loop in loops], np.float64).reshape(-1, 4, 4)
    covariances = np.array([loop.covariance for loop in loops], np.float64).reshape(-1, 6, 6)
    variances, axes = np.linalg.eigh(covariances[:, PLANAR[:, None], PLANAR])
    limited = (axes * np.minimum(variances, DEGENERATE_M**2)[:, None]) @ np.swapaxes(axes, 1, 2)
    return planar_pose(poses), limited


def frames_of(loops: Sequence[LoopClosure]) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Frames of the queries, and frames of the matches."""
    return np.array([loop.query for loop in loops], np.int64), np.array([loop.match for loop in loops], np.int64)


def in_metres(loop: LoopClosure, scale: Scale) -> LoopClosure:
    """Convert a loop of scans whose lengths were multiplied by `scale` to metres."""
    pose = scaled_poses(loop.match_from_query, 1 / scale)
    return dataclasses.replace(loop, match_from_query=pose, covariance=covariance_in_metres(loop.covariance, scale))


def covariance_in_metres(covariance: Float[np.ndarray, "6 6"], scale: Scale) -> Float[np.ndarray, "6 6"]:
    """Convert the covariance of a pose (x, y, z, rotations) with lengths multiplied by `scale` to metres."""
    factors = np.repeat([1 / scale, 1.0], 3)
    return covariance * np.outer(factors, factors)


def renumbered(
    loop: LoopClosure, new_frames: Sequence[Int[np.ndarray, " _"]] | Mapping[int, Int[np.ndarray, " _"]]
) -> LoopClosure:
    """Replace the frame numbers of a loop. `new_frames` has for each session the new number of each frame."""
    query, match = new_frames[loop.query_session][loop.query], new_frames[loop.match_session][loop.match]
    return dataclasses.replace(loop, query=int(query), match=int(match))


MEANING: dict[Reason, str] = {
    "little similarity": "The images fit too little, or the motion makes the pose improbable.",
    "repeats": "Another place, or another pose, fits about as well.",
    "too few neighbours": "Too few of the frames before and after the query show the same place.",
    "contradicts the motion": "The motion between the two frames, estimated from their images, leads elsewhere.",
    "contradicts the odometry": "The loop needs more drift of the odometry than was stated and than the images show.",
    "contradicts other loops": "The loop is not consistent with the largest set of loops that agree.",
    "little overlap": "The two scans, registered in 6 degrees of freedom, overlap too little.",
    "degenerate": f"The position is uncertain by more than {DEGENERATE_M:g} m along one direction, as between walls.",
}
"""Explanation of each reason for the user, one sentence each."""


def convert_rejected(
    rejected: Sequence[RejectedClosure], convert: Callable[[LoopClosure], LoopClosure]
) -> list[RejectedClosure]:
    """Apply a function to the loop of each rejected pair, and keep the reason."""
    return [RejectedClosure(convert(closure.loop), closure.reason) for closure in rejected]


def count_reasons(rejected: Sequence[RejectedClosure]) -> dict[Reason, int]:
    """Number of rejected pairs by reason, the most frequent reason first."""
    reasons: list[Reason] = [closure.reason for closure in rejected]
    return dict(Counter(reasons).most_common())


def why_rejected(rejected: Sequence[RejectedClosure]) -> list[str]:
    """Lines for the user: one for each reason, with its count and meaning."""
    return [f"rejected, {reason} ({count}): {MEANING[reason]}" for reason, count in count_reasons(rejected).items()]
