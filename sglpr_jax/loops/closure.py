"""A loop closure: two scans of one place, and the pose of one relative to the other."""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.mounting import Mounting, upright_from_lidar
from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.se3 import inverse, transform, transform_covariance, yaw_of

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
"""Why a pair that looked like a loop closure was rejected."""
UNSEEN_HEIGHT_M, UNSEEN_HEIGHT_PER_M = 0.03, 0.018
UNSEEN_TILT_DEG, UNSEEN_TILT_DEG_PER_M = 1.2, 0.07
"""Standard deviations of height, and of pitch and roll, which images do not show. Each has a value for two scans at one
position, and an increase per metre between them. They hold for vehicles, in simulated towns and outskirts and on
KITTI."""
GROUND_HEIGHT_PER_M, GROUND_TILT_DEG_PER_M = 0.008, 0.03
"""Increase of these standard deviations per metre between two scans whose mountings were estimated from the scans."""
UNKNOWN_HEIGHT_M = 10.0
"""Standard deviation of the height of a loop if nothing measures height: the scans may be on two storeys."""
DEGENERATE_M = 1.0
"""Maximum standard deviation of the position of a pose that is not degenerate, in metres."""


class FrameId(NamedTuple):
    """A frame of a session, both counted from 0: a node of a pose graph."""

    session: int
    frame: int


@dataclasses.dataclass(frozen=True, eq=False)
class LoopClosure:
    """Two frames of one place, with the pose between them."""

    query: int
    match: int
    """Frames, counted from 0 in each session. Of one session, the match is the earlier frame."""
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
        """The match and the query."""
        return FrameId(self.match_session, self.match), FrameId(self.query_session, self.query)

    @property
    def yaw(self) -> float:
        """Rotation of the query in the match's frame, in radians counter-clockwise."""
        return float(yaw_of(self.match_from_query))

    @property
    def information(self) -> Float[np.ndarray, "6 6"]:
        """The inverse of the covariance."""
        return np.linalg.inv(self.covariance)

    @property
    def is_degenerate(self) -> bool:
        """Whether the position is uncertain by more than `DEGENERATE_M` in some horizontal direction."""
        return bool(np.linalg.eigvalsh(self.covariance[:2, :2])[-1] > DEGENERATE_M**2)


def to_upright(loop: LoopClosure, *, query: Mounting | None, match: Mounting | None) -> LoopClosure:
    """The loop between the gravity-aligned frames of two sensors, from that between their LiDAR frames."""
    return _between_frames(loop, upright_from_lidar(query), upright_from_lidar(match))


def to_lidar(loop: LoopClosure, *, query: Mounting | None, match: Mounting | None) -> LoopClosure:
    """The loop between the LiDAR frames of two sensors, from that between their gravity-aligned frames."""
    return _between_frames(loop, inverse(upright_from_lidar(query)), inverse(upright_from_lidar(match)))


def _between_frames(loop: LoopClosure, query: Float[np.ndarray, "4 4"], match: Float[np.ndarray, "4 4"]) -> LoopClosure:
    """The loop between other frames of its scans, given the poses of the old frames in the new ones."""
    pose = match @ loop.match_from_query @ inverse(query)
    return dataclasses.replace(loop, match_from_query=pose, covariance=transform_covariance(loop.covariance, query))


def vertical_covariance(
    match_from_query: Float[np.ndarray, "4 4"], query: Mounting | None = None, match: Mounting | None = None
) -> Float[np.ndarray, "6 6"]:
    """Covariance of height, roll and pitch of a query in its own frame, between two gravity-aligned scans.

    Suspension and bumps tilt vehicles. With a tilt or a slope, the height error grows with the distance. If a mounting
    was estimated from its scan, its deviations count. A wrong tilt of the match lifts the query by its distance.
    """
    apart_m = float(np.hypot(*match_from_query[:2, 3]))
    if not any(sensor is not None and sensor.tilt_deviation_deg is not None for sensor in (query, match)):
        height = np.hypot(UNSEEN_HEIGHT_M, UNSEEN_HEIGHT_PER_M * apart_m)
        tilt = np.radians(np.hypot(UNSEEN_TILT_DEG, UNSEEN_TILT_DEG_PER_M * apart_m))
        return np.diag([0.0, 0.0, height, tilt, tilt, 0.0]) ** 2
    deviations = [(GROUND_HEIGHT_PER_M * apart_m, GROUND_TILT_DEG_PER_M * apart_m)]
    for sensor in (query, match):
        if sensor is None or sensor.height_deviation_m is None or sensor.tilt_deviation_deg is None:
            deviations.append((UNSEEN_HEIGHT_M / 2**0.5, UNSEEN_TILT_DEG / 2**0.5))
        else:
            deviations.append((sensor.height_deviation_m, sensor.tilt_deviation_deg))
    ground, own, other = (np.diag([0, 0, up, np.radians(tilt), np.radians(tilt), 0]) ** 2 for up, tilt in deviations)
    return own + transform_covariance(other, inverse(match_from_query)) + ground


@dataclasses.dataclass(frozen=True, eq=False)
class RejectedClosure:
    """A pair that looked like a loop closure, and the reason why it was rejected."""

    loop: LoopClosure
    reason: Reason


def planar_loop(
    query: int,
    match: int,
    alignment: BevRegistration,
    *,
    probability: float,
    knows_height: bool = True,
    sensors: tuple[Mounting | None, Mounting | None] = (None, None),
) -> LoopClosure:
    """Return the loop of two aligned images, between gravity-aligned frames.

    If the odometry does not measure height (`knows_height`), the storey is unknown. The deviations of the `sensors` at
    query and match count (`vertical_covariance`).
    """
    pose = transform(float(alignment.x), float(alignment.y), float(alignment.yaw))
    covariance = vertical_covariance(pose, *sensors)
    covariance[2, 2] += 0.0 if knows_height else UNKNOWN_HEIGHT_M**2
    to_query = np.eye(3)
    to_query[:2, :2] = pose[:2, :2].T  # the alignment's covariance is in the match's frame
    covariance[SEEN[:, None], SEEN] = to_query @ np.asarray(alignment.covariance, np.float64) @ to_query.T
    return LoopClosure(query, match, pose, covariance, float(probability))


Planar = Float[np.ndarray, "... 3"]
"""Poses in the plane: x, y, yaw."""

SEEN = np.array([0, 1, 5])
"""Rows of x, y and yaw in a covariance of 6 degrees of freedom."""


def planar(poses: Float[np.ndarray, "n 4 4"]) -> Planar:
    """Project poses to the x-y plane of their own frame."""
    return np.concatenate([poses[:, :2, 3], yaw_of(poses)[:, None]], axis=1)


def planar_loops(loops: Sequence[LoopClosure]) -> tuple[Planar, Float[np.ndarray, "n 3 3"]]:
    """Poses of the queries in the frames of their matches, and their covariances in the frames of the queries.

    Standard deviations are limited to `DEGENERATE_M` along every direction. Otherwise a pose that may lie anywhere
    along a wall would agree with every other pose along the wall.
    """
    poses = np.array([loop.match_from_query for loop in loops], np.float64).reshape(-1, 4, 4)
    covariances = np.array([loop.covariance for loop in loops], np.float64).reshape(-1, 6, 6)
    variances, axes = np.linalg.eigh(covariances[:, SEEN[:, None], SEEN])
    return planar(poses), (axes * np.minimum(variances, DEGENERATE_M**2)[:, None]) @ np.swapaxes(axes, 1, 2)


def frames_of(loops: Sequence[LoopClosure]) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Frames of the queries and of the matches."""
    return np.array([loop.query for loop in loops], np.int64), np.array([loop.match for loop in loops], np.int64)


def compose(a: Planar, b: Planar) -> Planar:
    """Return a_from_c of a_from_b and b_from_c."""
    a, b = np.broadcast_arrays(a, b)
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + cos * b[..., 0] - sin * b[..., 1]
    y = a[..., 1] + sin * b[..., 0] + cos * b[..., 1]
    return np.stack([x, y, wrap_angle(a[..., 2] + b[..., 2])], axis=-1)


def inverse_planar(a: Planar) -> Planar:
    """Return b_from_a of a_from_b."""
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack([-cos * a[..., 0] - sin * a[..., 1], sin * a[..., 0] - cos * a[..., 1], -a[..., 2]], axis=-1)


def relative(a: Planar, b: Planar) -> Planar:
    """Return the pose of b in the frame of a (`a_from_b`), from the poses of both in one common frame."""
    return compose(inverse_planar(a), b)


def wrap_angle(angle: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Wrap angles to the range from -pi to pi."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def scaled_drift(drift: DriftModel, factor: float) -> DriftModel:
    """Drift of odometry whose translations were multiplied by `factor`. Shares of the distance do not change."""
    return dataclasses.replace(drift, degrees_per_metre=drift.degrees_per_metre / factor)


def in_metres(loop: LoopClosure, scale: Scale) -> LoopClosure:
    """Loop of scans before all lengths were multiplied by `scale`."""
    pose = scaled_poses(loop.match_from_query, 1 / scale)
    return dataclasses.replace(loop, match_from_query=pose, covariance=covariance_in_metres(loop.covariance, scale))


def covariance_in_metres(covariance: Float[np.ndarray, "6 6"], scale: Scale) -> Float[np.ndarray, "6 6"]:
    """Covariance of a pose (x, y, z, rotations) before all lengths were multiplied by `scale`."""
    units = np.repeat([1 / scale, 1.0], 3)
    return covariance * np.outer(units, units)


def renumbered(loop: LoopClosure, numbers: Sequence[Int[np.ndarray, " _"]]) -> LoopClosure:
    """The loop with other numbers of its frames: those of the frames of each session."""
    query, match = numbers[loop.query_session][loop.query], numbers[loop.match_session][loop.match]
    return dataclasses.replace(loop, query=int(query), match=int(match))


MEANING: dict[Reason, str] = {
    "little similarity": "The images fit too little, or the motion makes the pose improbable.",
    "repeats": "Another place, or another pose, fits about as well.",
    "too few neighbours": "Too few of the frames before and after the query show the same place.",
    "contradicts the motion": "The motion between the two frames, estimated from their images, leads elsewhere.",
    "contradicts the odometry": "The loop needs more drift of the odometry than was stated.",
    "contradicts other loops": "The loop is not consistent with the largest set of loops that agree.",
    "little overlap": "The two scans, registered in 6 degrees of freedom, overlap too little.",
    "degenerate": f"The position is uncertain by more than {DEGENERATE_M:g} m along one direction, as between walls.",
}
"""Meaning of each reason, one sentence each."""


def counted(rejected: Sequence[RejectedClosure]) -> dict[Reason, int]:
    """Number of rejected pairs by reason, the most frequent reason first."""
    reasons: list[Reason] = [one.reason for one in rejected]
    return dict(Counter(reasons).most_common())


def why_rejected(rejected: Sequence[RejectedClosure]) -> list[str]:
    """Lines for the user: one for each reason, with its count and meaning."""
    return [f"rejected, {reason} ({count}): {MEANING[reason]}" for reason, count in counted(rejected).items()]
